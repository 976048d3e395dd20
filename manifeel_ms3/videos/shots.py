"""Shots of a video: images, forces and success of an episode, taken while it runs."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
from mani_skill.utils import common

from manifeel_ms3.evaluation.video import film_env
from manifeel_ms3.sensors.visualisation import observation_images
from manifeel_ms3.tasks.obs_modes import PAD

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


class VideoWrapper(gym.Wrapper):
    """Wrapper that takes shots of an episode, at chosen steps, while the episode runs.

    Args:
        env: Environment of `video_env`.
        take: Take to which the shots, forces and successes are added.
        view: Camera and pad to show.
        steps: Numbers of the control steps that are shown.
        on_step: Function that is called after the reset and after every step.
    """

    def __init__(self, env: gym.Env, take: Take, view: View, steps: set[int], on_step: Callable[[], None]):
        super().__init__(env)
        self._take, self._view, self._steps, self._on_step = take, view, steps, on_step

    def reset(self, **kwargs: Any):
        obs, info = self.env.reset(**kwargs)
        self._keep(obs, info)
        return obs, info

    def step(self, action: Any):
        obs, reward, terminated, truncated, info = self.env.step(action)
        self._keep(obs, info)
        return obs, reward, terminated, truncated, info

    def _keep(self, obs: dict[str, Any], info: dict[str, Any]) -> None:
        take, step = self._take, len(self._take.forces)
        take.forces.append(float(info["contact_force"]))
        take.successes.append(bool(info["success"]))
        if step in self._steps:
            take.shots.append(Shot(step, self._images(obs)))
        self._on_step()

    def _images(self, obs: dict[str, Any]) -> dict[str, np.ndarray]:
        base: Any = self.unwrapped
        scene: Any = self.env.render()
        shown = (self._view.camera, PAD + self._view.pad)
        sensors = {name: data for name, data in obs["sensor_data"].items() if name in shown}
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
