"""Global alignment of pairwise pointmaps: Gauss-Newton on cameras, depths, focal lengths and pair scales."""
