"""Calibration boards and tags: detection, corners as tracks, printed sheets, and the back end `marker`."""
