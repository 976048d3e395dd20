"""Steps per second of one environment in one process, for several observation modes: `python benchmarks/env_speed.py`.

The same run measures ManiSkill's own PegInsertionSide-v1 with its two cameras for comparison.
"""

import cProfile
import pstats
import time
from collections.abc import Callable
from dataclasses import dataclass

import gymnasium as gym
import mani_skill.envs  # noqa: F401
import numpy as np
import torch
import tyro
from mani_skill.utils.structs import Articulation
from rich.console import Console
from rich.table import Table

import manifeel_ms3  # noqa: F401
from manifeel_ms3.agents.controllers import HoldGripperController, LimitedLeadEEPoseController
from manifeel_ms3.rendering.backend import available_render_backend
from manifeel_ms3.sensors.depth.raycast import RaycastDepth
from manifeel_ms3.sensors.mechanics.contact import solve_indentation
from manifeel_ms3.sensors.mechanics.taxels import Taxels
from manifeel_ms3.sensors.optics.tacrgb import Optics
from manifeel_ms3.sensors.touch_model import TouchModel

EVERYTHING = "rgb+tacrgb+tacff"
TARGETS = {"state": 150, "rgb": 50, "rgb+tacff": 35, EVERYTHING: 25}
"""Goal of each observation mode, in steps per second; set once."""
CONTROLLERS = (LimitedLeadEEPoseController, HoldGripperController)
PARTS: dict[str, list[str | Callable]] = {
    "physics": ["pysapien.step"],
    "rendering": ["get_picture", "take_picture", "update_render"],
    "control": [Articulation.get_link_incoming_joint_forces, *(controller.set_action for controller in CONTROLLERS)],
    "rays": [RaycastDepth.look, RaycastDepth.heights],
    "gel mechanics": [solve_indentation, TouchModel._slide, Taxels.forces],
    "optics": [Optics.surface, Optics.shade],
}
"""Functions that make up each part of a step; those of SAPIEN, which are compiled, by a piece of their name."""
WARM_UP, PROFILED = 10, 50
"""Number of steps before the timed ones, and number of steps in the profile."""
ACTION_SCALE = 0.3
"""Largest component of the random actions, so that the arm stays near its start."""


@dataclass
class Args:
    steps: int = 200
    """Number of steps that are timed in each observation mode."""
    env_id: str = "ManiFeel-PegInsertion-v1"
    """Id of the task."""


def steps_per_second(env: gym.Env, steps: int) -> float:
    rng = np.random.default_rng(0)
    actions = rng.uniform(-ACTION_SCALE, ACTION_SCALE, (steps, *env.unwrapped.single_action_space.shape)).astype(np.float32)
    env.reset(seed=0)
    for action in actions[:WARM_UP]:
        env.step(action)
    begin = time.perf_counter()
    for action in actions:
        env.step(action)
    return steps / (time.perf_counter() - begin)


def shares(env: gym.Env, steps: int) -> dict[str, float]:
    """Share of each part in the time of a step."""
    profile = cProfile.Profile()
    profile.enable()
    for _ in range(steps):
        env.step(np.zeros(env.unwrapped.single_action_space.shape, np.float32))
    profile.disable()
    stats = pstats.Stats(profile).stats  # pyright: ignore[reportAttributeAccessIssue]
    total = sum(own_time for _, _, own_time, _, _ in stats.values())
    return {part: sum(_time_in(stats, function) for function in functions) / total for part, functions in PARTS.items()}


def _time_in(stats: dict, function: str | Callable) -> float:
    if isinstance(function, str):  # where two functions match, one calls the other, and the larger time holds both
        return max((entry[3] for (file, _, name), entry in stats.items() if file == "~" and function in name), default=0.0)
    code = function.__code__
    called = stats.get((code.co_filename, code.co_firstlineno, code.co_name))
    return called[3] if called else 0.0


def main(args: Args) -> None:
    console = Console()
    console.print(f"{torch.get_num_threads()} torch threads, renderer {available_render_backend()!r}")
    table = Table("environment", "observes", "steps/s", "wanted", *PARTS)
    for mode, target in TARGETS.items():
        env = gym.make(args.env_id, obs_mode=mode, sim_backend="physx_cpu")
        speed = steps_per_second(env, args.steps)
        parts = shares(env, PROFILED)
        if mode == EVERYTHING and (missing := [part for part, share in parts.items() if not share]):
            raise SystemExit(f"no function of {missing} was called although the task observes {mode}; correct PARTS")
        table.add_row(args.env_id, mode, f"{speed:.0f}", f">= {target}", *(f"{100 * share:.0f} %" for share in parts.values()))
        env.close()
    if available_render_backend() != "none":
        stock = gym.make(
            "PegInsertionSide-v1", obs_mode="rgb", sim_backend="physx_cpu", render_backend=available_render_backend()
        )
        speed = steps_per_second(stock, args.steps // 4)
        table.add_row("PegInsertionSide-v1 (ManiSkill's)", "rgb, 2 x 128 x 128", f"{speed:.1f}", "")
    console.print(table)


if __name__ == "__main__":
    main(tyro.cli(Args))
