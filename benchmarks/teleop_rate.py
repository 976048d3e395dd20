"""How often a second teleoperation could act, were it not to wait: `python benchmarks/teleop_rate.py`.

Steps an environment and shows it on the page, as `manifeel teleop` does; the task's control rate is what it must reach.
"""

import statistics
import time
from dataclasses import dataclass

import gymnasium as gym
import tyro
from rich.console import Console

import manifeel_ms3  # noqa: F401
from manifeel_ms3.agents.panda_gelsight import ACTION_AXES
from manifeel_ms3.teleop.operator import Operator
from manifeel_ms3.teleop.page import Page


@dataclass
class Args:
    task: str = "ManiFeel-USBInsertion-v1"
    cameras: tuple[str, ...] = ("wrist",)
    tactile_sensors: tuple[str, ...] = ("right",)
    steps: int = 60
    port: int = 8080


def main(args: Args) -> float:
    """Median Hz."""
    env = gym.make(
        args.task, obs_mode="rgb+tacrgb+tacff", cameras=list(args.cameras), tactile_sensors=list(args.tactile_sensors)
    )
    operator = Operator(ACTION_AXES[env.unwrapped.control_mode])
    page = Page(operator, args.task, "localhost", args.port)
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
