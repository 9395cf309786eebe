"""Captures, problems and machines with known answers, for benches, tests and examples; not installed."""
