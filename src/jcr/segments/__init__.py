"""Segmentation of a scene and measurement of its objects."""
