"""Parts that all policies share: observations, encoders, data, training, checkpoints."""
