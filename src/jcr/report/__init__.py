"""Report of a run as one HTML page, and the parts of it that other pages use."""
