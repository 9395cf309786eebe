"""Calibration of a capture: fit, adjustment, checks, verdict, requirement."""
