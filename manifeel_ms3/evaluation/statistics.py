"""Intervals for success rates."""


def wilson_interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Wilson score interval of a success rate (Wilson 1927).

    Args:
        successes: Number of episodes that succeeded.
        trials: Number of episodes.
        confidence: Share of such intervals that contain the true rate.
    """
    from scipy.stats import binomtest  # takes a third of a second, needed only where an interval is computed

    interval = binomtest(successes, trials).proportion_ci(confidence, method="wilson")
    return float(interval.low), float(interval.high)
