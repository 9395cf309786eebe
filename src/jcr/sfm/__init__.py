"""Structure from motion: mapping, registration of new images and given cameras."""
