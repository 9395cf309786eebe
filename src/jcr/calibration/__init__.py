"""Hand-eye calibration of a capture: fit, bundle adjustment, checks, verdict, required accuracy."""
