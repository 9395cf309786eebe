"""3D view of a run in the browser."""
