"""Evaluate a policy on fixed seeds.

    python -m manifeel_ms3.evaluation.evaluate --checkpoint runs/x/checkpoints/last
    python -m manifeel_ms3.evaluation.evaluate --policy my_module:MyPolicy --env-id ManiFeel-PegInsertion-v1 --obs-mode rgb+tacff

Writes one json (`data/evaluation_schema.json` says of what form): versions, git commit, the policy's config, the outcome of
every episode, success rates with Wilson intervals. A policy that raises, answers NaN or the wrong shape, or does not answer
fails that episode, with the reason; the evaluation goes on.
"""

import json
import logging
import sys
from concurrent.futures import as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch
import tyro
from pebble import ProcessExpired, ProcessPool

from manifeel_ms3.command_line import json_object, run
from manifeel_ms3.progress import progress_bar
from manifeel_ms3.tasks.registry import evaluation_seeds, make_env

from .checkpoint_config import checkpoint_config
from .policy import PolicySource
from .result import result_of, write_result
from .rollout import EpisodeOutcome, evaluate_episode

log = logging.getLogger(__name__)


@dataclass
class Args:
    checkpoint: Path | None = None
    """folder with config.json and weights"""
    policy: str | None = None
    """instead: a policy of your own, "module:Class", or the address of its server, "http://localhost:8000" """
    policy_kwargs: str = "{}"
    """arguments of the policy, as json"""
    env_id: str | None = None
    """task; a checkpoint knows its own"""
    obs_mode: str | None = None
    """what the policy sees; a checkpoint knows"""
    cameras: tuple[str, ...] | None = None
    """cameras that it sees; a checkpoint knows; default: the task's policy camera"""
    tactile_sensors: tuple[str, ...] = ("right",)
    """pads that it sees; a checkpoint knows"""
    out: Path | None = None
    """json to write; default: evaluation.json beside the checkpoints, or here"""
    episodes: int = 50
    """the first so many of the task's evaluation seeds"""
    workers: int = 1
    """processes"""
    inference_steps: int | None = None
    """steps of generation, if other than the checkpoint's"""
    step_timeout: float = 60.0
    """s that the policy may take for an action"""
    env_kwargs: str = "{}"
    """arguments of the task as json, such as '{"fit": "loose"}'"""
    videos: tuple[int, ...] = ()
    """numbers of episodes (from 0) to film, with cameras and touch, into a folder beside the json"""


@dataclass(frozen=True)
class Evaluation:
    """What is evaluated, on what."""

    source: PolicySource
    env_id: str
    env_kwargs: dict[str, Any]
    config: dict[str, Any]
    """of the policy"""


def main(args: Args) -> Path:
    """Evaluate, and return the json's path.

    Raises:
        CheckpointError: the checkpoint cannot be used.
        PolicyError: the policy cannot be made.
        ValueError: it is not said what to evaluate, or on what.
    """
    evaluation = what_to_evaluate(args)
    seeds = evaluation_seeds(args.episodes)
    if wrong := [number for number in args.videos if not 0 <= number < len(seeds)]:
        raise ValueError(f"videos {wrong} are asked for, the episodes are 0 to {len(seeds) - 1}")
    outcomes = run_episodes(evaluation, seeds, args.workers, args.step_timeout)
    out = args.out or (args.checkpoint.parent.parent if args.checkpoint else Path()) / "evaluation.json"
    write_result(result_of(evaluation.env_id, evaluation.env_kwargs, evaluation.config, outcomes), out)
    for number in args.videos:
        film(evaluation, outcomes[number].seed, out.parent / "videos")
    log.info("%s", out)
    return out


def what_to_evaluate(args: Args) -> Evaluation:
    """From the checkpoint's config, or from the arguments."""
    if (args.checkpoint is None) == (args.policy is None):
        raise ValueError("give either --checkpoint, or --policy with --env-id and --obs-mode")
    extra = dict(sim_backend="physx_cpu") | json_object("--env-kwargs", args.env_kwargs)
    policy_kwargs = json_object("--policy-kwargs", args.policy_kwargs)
    if args.checkpoint is not None:
        config = checkpoint_config(args.checkpoint)
        kwargs = policy_kwargs | dict(inference_steps=args.inference_steps)
        sensing = {name: config[name] for name in ("obs_mode", "cameras", "tactile_sensors")}
        source = PolicySource(args.checkpoint, kwargs=json.dumps(kwargs))
        return Evaluation(source, config["env_id"], sensing | extra, config)
    if args.env_id is None or args.obs_mode is None:
        raise ValueError("a --policy of your own needs --env-id and --obs-mode")
    sensing = dict(obs_mode=args.obs_mode, cameras=args.cameras, tactile_sensors=args.tactile_sensors)
    source = PolicySource(policy=args.policy, kwargs=args.policy_kwargs)
    config = dict(policy_name=args.policy, policy_kwargs=policy_kwargs, obs_mode=args.obs_mode)
    return Evaluation(source, args.env_id, {n: v for n, v in sensing.items() if v is not None} | extra, config)


def run_episodes(evaluation: Evaluation, seeds: list[int], workers: int, step_timeout: float) -> list[EpisodeOutcome]:
    """Outcomes in the seeds' order; an episode whose process dies has failed."""
    outcomes = {}
    with (
        progress_bar() as bar,
        ProcessPool(workers, context=get_context("spawn"), initializer=_start_worker, initargs=(evaluation,)) as pool,
    ):
        task = bar.add_task("evaluating", total=len(seeds))
        seed_of = {pool.schedule(_run_seed, args=(seed, step_timeout)): seed for seed in seeds}
        for future in as_completed(seed_of):
            seed = seed_of[future]
            try:
                outcomes[seed] = future.result()
            except ProcessExpired as error:
                reason = f"the policy's process ended with exit code {error.exitcode}: it crashed, or hung for good"
                outcomes[seed] = EpisodeOutcome(seed, False, False, 0, 0.0, 0.0, reason)
            won = sum(outcome.success_once for outcome in outcomes.values())
            bar.update(task, advance=1, description=f"evaluating, {won} of {len(outcomes)} succeed")
    return [outcomes[seed] for seed in seeds]


_worker: dict[str, Any] = {}


def _start_worker(evaluation: Evaluation) -> None:
    torch.set_num_threads(1)  # processes share the cores, and sums do not depend on their number
    _worker.update(evaluation=evaluation)


def _run_seed(seed: int, step_timeout: float) -> EpisodeOutcome:
    if "env" not in _worker:  # here, not at the worker's start, where an error would be lost
        import manifeel_ms3  # noqa: F401

        evaluation = _worker["evaluation"]
        _worker.update(env=make_env(evaluation.env_id, **evaluation.env_kwargs), policy=evaluation.source.make())
    return evaluate_episode(_worker["env"], _worker["policy"], seed, step_timeout=step_timeout)


def film(evaluation: Evaluation, seed: int, folder: Path) -> Path:
    """Roll an episode out again, with every picture, into an mp4."""
    from .video import record_episode, video

    _, frames = record_episode(evaluation.env_id, evaluation.env_kwargs, evaluation.source.make(), seed)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{seed}.mp4"
    path.write_bytes(video(frames))
    return path


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args)))
