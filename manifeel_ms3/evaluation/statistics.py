"""Intervals for success rates."""

CONFIDENCE = 0.95
"""Share of intervals that contain the true rate."""


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Wilson score interval of a success rate (Wilson 1927).

    Args:
        successes: Number of episodes that succeeded.
        trials: Number of episodes.
    """
    from scipy.stats import binomtest  # takes a third of a second, needed only where an interval is computed

    interval = binomtest(successes, trials).proportion_ci(CONFIDENCE, method="wilson")
    return float(interval.low), float(interval.high)
