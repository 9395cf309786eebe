"""Pointmaps of networks: pairwise or in one frame, predicted here or read from a file, refined by matches."""
