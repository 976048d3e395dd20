"""Run one policy on fixed seeds, and write one result file."""

from .policy import Policy
from .rollout import EpisodeOutcome, evaluate_episode

__all__ = ["EpisodeOutcome", "Policy", "evaluate_episode"]
