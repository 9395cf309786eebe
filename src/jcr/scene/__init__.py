"""Map of a scene: cloud, training, queries."""
