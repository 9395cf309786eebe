"""Pointmaps of networks, pairwise or in one frame: prediction, import from a file, and refinement by matches."""
