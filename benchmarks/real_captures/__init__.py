"""Recipes of real captures: public repositories, and where images, poses and intrinsics are stored in each."""
