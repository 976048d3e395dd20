"""Record, train and evaluate whatever a study combines; see `python -m manifeel_ms3.evaluation.matrix --help`."""
