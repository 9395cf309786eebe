"""Networks that see all views at once: images in, depth, confidence and cameras of every view out.

An adapter each (da3, mapanything, moge) converts its package's conventions to ours; all else is shared.
"""
