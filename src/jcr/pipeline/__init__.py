"""Pipeline from a capture to a run folder: stages, their files, and the commands that run them."""
