"""Dense depth on known cameras."""
