"""Map of a scene: point cloud, training of occupancy, colour and label fields, and queries."""
