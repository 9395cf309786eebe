"""Calibration boards and tags: detection, corners in tracks, and the back end marker."""
