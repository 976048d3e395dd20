"""Record, train and evaluate whatever a study combines; see `python -m baselines.studies --help`."""
