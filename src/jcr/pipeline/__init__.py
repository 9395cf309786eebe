"""Pipeline from a capture to a run folder: its stages, the files that they write, and functions that run them."""
