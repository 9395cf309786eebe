"""Alignment of cameras by the colours of their images, without features."""
