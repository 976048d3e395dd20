"""What stages cost on this machine: what those like them took here, or else what a trial of their work says."""

import hashlib
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch

import manifeel_ms3  # noqa: F401
from baselines.common.agent import spec_of
from baselines.common.observation import POSE, POSE_FEATURES
from baselines.common.train_args import default_steps
from baselines.registry import policy_spec
from manifeel_ms3.demonstrations.formats.maniskill_h5 import read_header
from manifeel_ms3.evaluation.provenance import machine
from manifeel_ms3.files import write_json
from manifeel_ms3.paths import data_dir

from .jobs import DONE, read_note, training_args
from .study import Stage

TRIALS = "trials.json"
STEPS = 20  # of simulation, in a trial
AMOUNTS = {
    "num",
    "episodes",
    "checkpoints",
    "version",
    "revision",
}  # settings, and flags of training, that do not change what a unit takes
AMOUNT_FLAGS = {"seed", "env-id", "steps", "keep", "save-every", "num-demos", "tacrgb-weights"}


@dataclass(frozen=True)
class Estimate:
    seconds: float
    """of wall clock, with the resources asked for"""
    source: str


def estimate(stage: Stage, root: Path, workers: int, try_out: bool = True) -> Estimate | None:
    """How long a stage will take, with so many processes that simulate.

    Args:
        try_out: measure what has not been done here yet; otherwise the answer is None then.
    """
    parallel = 1 if stage.kind == "train" else workers
    took = [note["seconds"] / max(note["units"], 1) * note["parallel"] for note in _done(stage, root)]
    if took:
        return Estimate(float(np.median(took)) * _units(stage) / parallel, "runs here")
    if not try_out:
        return None
    return Estimate(_tried(stage, root) * _units(stage) / parallel, "a trial")


def _done(stage: Stage, root: Path) -> list[dict[str, Any]]:
    """Notes of stages that were done here and differ in amounts and seeds alone."""
    here = machine()
    notes = [_note(path, path.stat().st_mtime) for path in root.glob(f"{stage.kind}/*/{DONE}")]
    return [note for note in notes if note["machine"] == here and _work(note["settings"]) == _work(stage.settings)]


@cache
def _note(path: Path, _changed: float) -> dict[str, Any]:
    return read_note(path)


def _work(settings: dict[str, Any]) -> dict[str, Any]:
    """What a unit's cost depends on."""
    flags = {name: value for name, value in settings.get("flags", {}).items() if name not in AMOUNT_FLAGS}
    return {name: value for name, value in settings.items() if name not in AMOUNTS} | dict(flags=flags)


def _units(stage: Stage) -> int:
    """Demonstrations, gradient steps, episodes."""
    settings = stage.settings
    if stage.kind == "record":
        return settings["num"]
    if stage.kind == "evaluate":
        return settings["episodes"] * settings["checkpoints"]
    args, (record,) = training_args(stage), stage.needs
    demos = args.num_demos or record.settings["num"]
    samples = demos * _steps_of_a_demonstration(record.settings["env_id"])
    return args.steps or default_steps(demos, samples, args.batch_size)


@cache
def _steps_of_a_demonstration(env_id: str) -> float:
    """Of those that come along."""
    episodes = read_header(data_dir() / "sample" / env_id / "states.h5")["episodes"]
    return float(np.mean([episode["elapsed_steps"] for episode in episodes]))


# -------------------------------------------------------------------- trials


def _tried(stage: Stage, root: Path) -> float:
    """Seconds a unit, from a short trial; kept under the root."""
    work = [stage.kind, _work(stage.settings), [_work(need.settings) for need in stage.needs], machine()]
    key = hashlib.sha256(json.dumps(work, sort_keys=True).encode()).hexdigest()[:16]
    known = read_note(root / TRIALS)
    if key not in known:
        known[key] = dict(seconds=TRIAL[stage.kind](stage), title=stage.title)
        root.mkdir(parents=True, exist_ok=True)
        write_json(root / TRIALS, known)
    return known[key]["seconds"]


def _try_recording(stage: Stage) -> float:
    settings = stage.settings
    step = _seconds_a_step(settings["env_id"], "rgb+tacrgb+tacff", settings["camera"], settings["env_kwargs"])
    return step * _steps_of_a_demonstration(settings["env_id"])


def _try_training(stage: Stage) -> float:
    """One gradient step of the networks as they will be, on made-up observations."""
    args = training_args(stage)
    policy, obs, actions = _made_up(stage, args, args.batch_size)
    optimizer = torch.optim.AdamW(policy.parameters(), fused=True)

    def step() -> None:
        with torch.autocast(args.device, torch.bfloat16, enabled=args.precision == "bf16"):
            loss = policy(obs, actions)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        loss.item()

    return _seconds(step, repeats=2)


def _try_evaluation(stage: Stage) -> float:
    """An episode that goes on to its end."""
    (train,) = stage.needs
    args = training_args(train)
    policy, obs, _ = _made_up(train, args, 1)
    policy.to("cpu").eval()
    obs = {name: value.cpu() for name, value in obs.items()}
    inference = _seconds(lambda: policy.sample(obs, args.inference_steps, torch.Generator()), repeats=1)
    step = _seconds_a_step(args.env_id, args.obs_mode, args.cameras[0], stage.settings["env_kwargs"])
    limit = json.loads(stage.settings["env_kwargs"]).get("max_episode_steps") or gym.spec(args.env_id).max_episode_steps
    return limit * (step + inference / args.policy.action_horizon)


TRIAL: dict[str, Callable[[Stage], float]] = dict(record=_try_recording, train=_try_training, evaluate=_try_evaluation)


def _made_up(train: Stage, args: Any, batch: int) -> tuple[Any, dict[str, torch.Tensor], torch.Tensor]:
    """A policy, and a batch of noise as it takes."""
    policy_class = policy_spec(train.settings["policy"]).policy_class
    spec = spec_of(vars(args))
    env_kwargs = json.loads(train.needs[0].settings["env_kwargs"])
    env = gym.make(args.env_id, **dict(obs_mode="none", render_backend="none") | env_kwargs)
    (size,) = env.unwrapped.single_action_space.shape
    env.close()
    policy = policy_class(args.policy, spec, size).to(args.device, memory_format=torch.channels_last)
    shapes = dict.fromkeys(spec.images, (spec.image_size, spec.image_size, 3))
    shapes |= dict.fromkeys(spec.force_fields, (10, 14, 3)) | {POSE: (POSE_FEATURES,)}
    obs = {}
    for key, shape in shapes.items():
        values = torch.rand(batch, args.policy.obs_horizon, *shape, device=args.device)
        obs[key] = (255 * values).to(torch.uint8) if key in spec.images else values
    return policy, obs, torch.rand(batch, args.policy.pred_horizon, size, device=args.device)


@cache
def _seconds_a_step(env_id: str, obs_mode: str, camera: str, env_kwargs: str) -> float:
    """Of simulation, by random actions."""
    sensing = dict(obs_mode=obs_mode, cameras=(camera,), tactile_sensors=("right",), sim_backend="physx_cpu")
    env = gym.make(env_id, **sensing | json.loads(env_kwargs))
    env.reset(seed=0)
    seconds = _seconds(lambda: env.step(env.action_space.sample()), repeats=STEPS)
    env.close()
    return seconds


def _seconds(do: Callable[[], Any], repeats: int) -> float:
    """Of one, after a first that is not counted."""
    do()
    begin = time.perf_counter()
    for _ in range(repeats):
        do()
    return (time.perf_counter() - begin) / repeats
