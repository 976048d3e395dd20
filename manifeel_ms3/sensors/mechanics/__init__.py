"""Forces on a pad: the measured wrench, and the gel that carries it."""
