"""Shots of a video: images, forces and success of an episode."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, cast

import gymnasium as gym
import numpy as np
from mani_skill.utils import common

from manifeel_ms3.evaluation.video import film_env
from manifeel_ms3.sensors.visualisation import observation_images
from manifeel_ms3.tasks.obs_modes import PAD
from manifeel_ms3.tasks.visuotactile_env import CONTROL_FREQ

SCENE_SIZE = 480
"""Width and height of the image of the scene, in pixels; chosen by eye."""


@dataclass(frozen=True)
class View:
    """The camera and the pad that a video shows beside the scene and the contact force."""

    camera: str
    """Name of the camera: front, side or wrist."""
    pad: str
    """Side of the finger pad, "left" or "right"."""


@dataclass
class Shot:
    """One moment of a video."""

    step: int
    """Number of control steps since the start of the episode."""
    images: dict[str, np.ndarray]
    """RGB images (H, W, 3) uint8: "scene", and the others by their captions."""


@dataclass
class Take:
    """Everything that a video needs of one episode."""

    title: str
    """Task, origin and seed of the episode."""
    force_limit: float | None
    """Largest contact force of a gentle success of the task, in N; None if not known."""
    shots: list[Shot] = field(default_factory=list)
    """Shots of the steps that are shown, in their order."""
    forces: list[float] = field(default_factory=list)
    """Contact force at the start, where it is 0, and of every control step, in N."""
    successes: list[bool] = field(default_factory=list)
    """Whether the task has succeeded, for the start and every control step."""
    control_freq: int = CONTROL_FREQ
    """Control steps per second."""


def shot_images(env: gym.Env, obs: dict[str, Any], view: View) -> dict[str, np.ndarray]:
    """The images of a shot, of the moment of an observation of `video_env`."""
    base, scene = cast(Any, env.unwrapped), cast(Any, env.render())
    sensors = {name: data for name, data in obs["sensor_data"].items() if name in (view.camera, PAD + view.pad)}
    return dict(scene=common.to_numpy(scene)[0]) | observation_images(dict(sensor_data=sensors), base.touch_full_scales)


def video_env(env_id: str, env_kwargs: Mapping[str, Any], view: View) -> gym.Env:
    """The environment of an episode, with the scene, the camera and the pad of a video added to what it renders.

    Args:
        env_id: Id of the task.
        env_kwargs: Arguments of `gym.make` with which the episode was recorded or evaluated.
        view: Camera and pad of the video.

    Raises:
        MachineError: This machine has no renderer.
    """
    scene: dict[str, Any] = dict(render_mode="rgb_array", human_render_camera_configs=dict(width=SCENE_SIZE, height=SCENE_SIZE))
    return film_env(env_id, env_kwargs, (view.camera,), (view.pad,), **scene)


def shown_steps(length: int, most: int | None) -> set[int]:
    """Numbers of the control steps that are shown of an episode, evenly spread, with the first and the last one.

    Args:
        length: Number of control steps of the episode.
        most: Largest number of shots; every step is shown if not given.
    """
    if most is None or most > length:
        return set(range(length + 1))
    return set(np.linspace(0, length, most).round().astype(int).tolist())
