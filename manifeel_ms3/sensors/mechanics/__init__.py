"""Forces on a pad: the measured wrench, and the mechanics of the gel that carries it."""
