from .policy import Policy as Policy
from .rollout import EpisodeOutcome as EpisodeOutcome
from .rollout import evaluate_episode as evaluate_episode
