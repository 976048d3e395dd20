"""Measures how fast each task is simulated: `python benchmarks/physics_speed.py`.

It plays the sample demonstrations again, with their contacts and without observations, and prints multiples of real time: of
the engine alone, and of whole steps (with controller and measures, without rewards).
"""

import time
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import torch
import tyro
from rich.console import Console
from rich.table import Table

import manifeel_ms3  # noqa: F401
from manifeel_ms3.demonstrations.formats.maniskill_h5 import group_of, open_trajectories, read_header
from manifeel_ms3.demonstrations.recording import STATES_FILE
from manifeel_ms3.paths import data_dir
from manifeel_ms3.tasks.registry import all_tasks


@dataclass
class Args:
    tasks: tuple[str, ...] = tuple(all_tasks())
    """Ids of the tasks."""


def real_time_factors(task: str) -> tuple[float, float]:
    """Simulated time over computing time of the engine alone, and of whole steps, over all sample demonstrations."""
    path = data_dir() / "sample" / task / STATES_FILE
    seconds = np.zeros(3)
    episodes = read_header(path)["episodes"]
    with open_trajectories(path) as file:
        actions = [group_of(file, episode)["actions"][()] for episode in episodes]
    for episode, played in zip(episodes, actions, strict=True):
        seconds += seconds_of(task, episode["episode_seed"], played)
    simulated, engine, whole = seconds
    return simulated / engine, simulated / whole


def seconds_of(task: str, seed: int, actions: np.ndarray) -> tuple[float, float, float]:
    """Simulated time of an episode, and computing time of the engine alone and of whole steps, in s."""
    env = gym.make(task, obs_mode="none", reward_mode="none", render_backend="none")
    env.reset(seed=seed)
    scene, spent = env.unwrapped.scene, [0.0]
    step = scene.step

    def timed_step():
        start = time.perf_counter()
        step()
        spent[0] += time.perf_counter() - start

    scene.step = timed_step
    start = time.perf_counter()
    for action in actions:
        env.step(action)
    whole = time.perf_counter() - start
    simulated = len(actions) / env.unwrapped.control_freq
    env.close()
    return simulated, spent[0], whole


def main(args: Args) -> None:
    torch.set_num_threads(1)
    table = Table("task", "engine alone", "whole steps", title="times real time, one core")
    for task in args.tasks:
        engine, whole = real_time_factors(task)
        table.add_row(task, f"{engine:.1f}", f"{whole:.1f}")
    Console().print(table)


if __name__ == "__main__":
    main(tyro.cli(Args))
