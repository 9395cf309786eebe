"""Problems and machines with known answers, without images: for benches, tests and examples."""
