"""Structure from motion with COLMAP: mapping, registration of new images, and triangulation with given cameras."""
