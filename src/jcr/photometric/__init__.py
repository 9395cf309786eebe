"""Estimation of camera poses by photometric alignment of the images, without features."""
