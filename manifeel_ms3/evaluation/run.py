"""Evaluate a checkpoint on fixed seeds: `python -m manifeel_ms3.evaluation.run --checkpoint runs/x/checkpoints/last`.

Writes one json: versions, git commit, the policy's config, the outcome of every episode, success rates with Wilson intervals.
"""

import json
import logging
import subprocess
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from importlib.metadata import version
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
import tyro

from manifeel_ms3.paths import data_dir
from manifeel_ms3.progress import progress_bar

from .checkpoint_config import checkpoint_config
from .policy import load_policy
from .rollout import EpisodeOutcome, evaluate_episode
from .statistics import wilson_interval

log = logging.getLogger(__name__)
SCHEMA = "manifeel-evaluation-1"


@dataclass
class Args:
    checkpoint: Path
    """folder with config.json and weights"""
    out: Path | None = None
    """json to write; default: evaluation.json beside the checkpoint"""
    episodes: int = 50
    """the first so many of the task's evaluation seeds"""
    workers: int = 1
    """processes"""
    inference_steps: int | None = None
    """denoising steps, if other than the checkpoint's"""
    env_kwargs: str = "{}"
    """arguments of the task as json, such as '{"fit": "loose"}'"""


def evaluation_seeds(env_id: str, count: int) -> list[int]:
    """The task's fixed seeds, disjoint from those that demonstrations are recorded with.

    Raises:
        ValueError: the task is unknown, or has fewer seeds.
    """
    seeds = json.loads((data_dir() / "eval_seeds.json").read_text())
    if env_id not in seeds:
        raise ValueError(f"{env_id!r} has no evaluation seeds; there are some for {sorted(seeds)}")
    if not 0 < count <= len(seeds[env_id]):
        raise ValueError(f"{count} evaluation episodes are asked for; {env_id} has {len(seeds[env_id])} seeds")
    return seeds[env_id][:count]


def main(args: Args) -> Path:
    """Evaluate, and return the json's path."""
    config = checkpoint_config(args.checkpoint)
    env_kwargs = _env_kwargs(config, args.env_kwargs)
    seeds = evaluation_seeds(config["env_id"], args.episodes)
    policy_kwargs = dict(inference_steps=args.inference_steps)
    outcomes = []
    context = get_context("spawn")
    with (
        progress_bar() as bar,
        ProcessPoolExecutor(
            args.workers, context, _start_worker, (config["env_id"], env_kwargs, args.checkpoint, policy_kwargs)
        ) as pool,
    ):
        task = bar.add_task("evaluating", total=len(seeds))
        for future in as_completed([pool.submit(_run_seed, seed) for seed in seeds]):
            outcomes.append(future.result())
            won = sum(outcome.success_once for outcome in outcomes)
            bar.update(task, advance=1, description=f"evaluating, {won} of {len(outcomes)} succeed")
    outcomes.sort(key=lambda outcome: outcome.seed)
    out = args.out or args.checkpoint.parent.parent / "evaluation.json"
    out.write_text(json.dumps(result_of(config, env_kwargs, outcomes), indent=2))
    log.info("%s", out)
    return out


def result_of(config: dict[str, Any], env_kwargs: dict[str, Any], outcomes: list[EpisodeOutcome]) -> dict[str, Any]:
    """The result json's content."""
    rates = {}
    for name in ("success_once", "success_at_end"):
        won = sum(getattr(outcome, name) for outcome in outcomes)
        low, high = wilson_interval(won, len(outcomes))
        rates[name] = dict(rate=won / len(outcomes), low=round(low, 4), high=round(high, 4))
    return dict(
        schema=SCHEMA,
        env_id=config["env_id"],
        env_kwargs=env_kwargs,
        obs_mode=config["obs_mode"],
        policy=config["kind"],
        training_seed=config["seed"],
        config=config,
        versions={name: version(name) for name in ("manifeel-ms3", "mani-skill", "sapien", "torch")},
        git_commit=_git_commit(),
        **rates,
        mean_length=float(np.mean([outcome.length for outcome in outcomes])),
        episodes=[asdict(outcome) for outcome in outcomes],
    )


def _env_kwargs(config: dict[str, Any], extra: str) -> dict[str, Any]:
    sensing = {name: config[name] for name in ("obs_mode", "cameras", "tactile_sensors")}
    return sensing | dict(sim_backend="physx_cpu") | json.loads(extra)


def _git_commit() -> str | None:
    answer = subprocess.run(
        ["git", "rev-parse", "HEAD"], capture_output=True, text=True, cwd=Path(__file__).parent, check=False
    )
    return answer.stdout.strip() or None


_worker: dict[str, Any] = {}


def _start_worker(env_id: str, env_kwargs: dict[str, Any], checkpoint: Path, policy_kwargs: dict[str, Any]) -> None:
    torch.set_num_threads(1)  # processes share the cores, and sums do not depend on their number
    import manifeel_ms3  # noqa: F401

    _worker.update(env=gym.make(env_id, **env_kwargs), policy=load_policy(checkpoint, **policy_kwargs))


def _run_seed(seed: int) -> EpisodeOutcome:
    return evaluate_episode(_worker["env"], _worker["policy"], seed)


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    main(tyro.cli(Args))
