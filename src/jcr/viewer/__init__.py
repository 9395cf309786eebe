"""Interactive 3D view of a run in the browser, with viser."""
