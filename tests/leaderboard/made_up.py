"""Submissions with made-up outcomes, which have the published form."""

import json
from pathlib import Path

import numpy as np

from manifeel_ms3.evaluation.result import result_of, write_result
from manifeel_ms3.evaluation.rollout import EpisodeOutcome
from manifeel_ms3.tasks.registry import evaluation_seeds
from tests.outcomes import made_up as made_up_outcome

EPISODES = evaluation_seeds(50)


def outcomes_of(won: int, rng: np.random.Generator) -> list[EpisodeOutcome]:
    """50 episodes of which the first ones succeed."""
    forces = rng.uniform(5, 40, 50).round(3)
    return [made_up_outcome(seed, k < won, 150, float(forces[k])) for k, seed in enumerate(EPISODES)]


def made_up(folder: Path, name: str, task: str, mode: str, won: int, seeds: int = 2, steps: int = 2) -> Path:
    """A submission's folder, with the results of two checkpoints of two training seeds unless told otherwise."""
    folder.mkdir(parents=True)
    (folder / "submission.json").write_text(json.dumps(dict(name=name, authors="Us")))
    rng = np.random.default_rng(0)
    for seed in range(seeds):
        for step in range(100, 100 * steps + 1, 100):
            config = dict(policy_name="diffusion_policy", obs_mode=mode, seed=seed, step=step, num_demos=50)
            result = result_of(f"ManiFeel-{task}-v1", dict(obs_mode=mode, cameras=["wrist"]), config, outcomes_of(won, rng))
            write_result(result, folder / f"results/{seed}/{step:08d}.json")
    return folder
