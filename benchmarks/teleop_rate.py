"""Measure how many steps per second teleoperation can take without waiting: `python benchmarks/teleop_rate.py`.

Steps an environment and shows it on the page, as `manifeel teleop` does. The rate must reach the task's control rate.
"""

import statistics
import time
from dataclasses import dataclass

import gymnasium as gym
import tyro
from rich.console import Console

import manifeel_ms3  # noqa: F401
from manifeel_ms3.teleop.operator import Operator, steerable_axes
from manifeel_ms3.teleop.page import Page


@dataclass
class Args:
    task: str = "ManiFeel-USBInsertion-v1"
    """Id of the task."""
    cameras: tuple[str, ...] = ("wrist",)
    """Cameras to show."""
    tactile_sensors: tuple[str, ...] = ("right",)
    """Sides of the tactile sensors to show."""
    steps: int = 60
    """Number of steps to time."""
    port: int = 8080
    """Port of the page."""


def main(args: Args) -> float:
    """Print and return the median rate, in Hz."""
    env = gym.make(
        args.task, obs_mode="rgb+tacrgb+tacff", cameras=list(args.cameras), tactile_sensors=list(args.tactile_sensors)
    )
    operator = Operator(steerable_axes(env.unwrapped.control_mode))
    page = Page(operator, args.task, "localhost", args.port, env.unwrapped.touch_full_scales)
    env.reset(seed=0)
    took = []
    for step in range(args.steps):
        start = time.perf_counter()
        operator.push("z", -0.5 if step < args.steps / 2 else 0.5)
        obs, _, _, _, info = env.step(operator.action())
        page.show(obs, info)
        took.append(time.perf_counter() - start)
    page.stop()
    rate = 1 / statistics.median(took)
    Console().print(f"{args.task}: {rate:.1f} Hz, the task's control rate is {env.unwrapped.control_freq} Hz")
    env.close()
    return rate


if __name__ == "__main__":
    main(tyro.cli(Args))
