"""Observation modes: ManiSkill's strings, and two tokens for touch."""

import logging
from collections.abc import Iterable
from typing import Any

from mani_skill.envs.utils.observations import ALL_VISUAL_TEXTURES

from manifeel_ms3.arguments import several_of
from manifeel_ms3.errors import InvalidArgumentError

log = logging.getLogger(__name__)
PAD = "tactile_"
"""Prefix of the names of tactile pads among the sensors of an observation."""
POSE = "extra/tcp_pose"
"""Path of the pose of the tool centre point in an observation: x, y, z in m and a quaternion wxyz."""
TACTILE_TOKENS = {"tacrgb": "rgb", "tacff": "force_field"}
"""Outputs of a tactile sensor by their tokens in an observation mode."""
STATE_TOKENS = ("state", "state_dict")
"""ManiSkill's tokens of the state, as a vector and as nested dicts."""
WHOLE_MODES = ("none", "sensor_data", "pointcloud", "rgbd")
"""ManiSkill's modes that are not joined with its other tokens; "rgbd" and "pointcloud" may be joined with touch."""


def has_images(own_mode: str) -> bool:
    """Whether ManiSkill's own part of an `obs_mode` holds images of cameras."""
    return own_mode not in ("none", *STATE_TOKENS)


def in_usual_order(obs_mode: str) -> str:
    """The same mode with its tactile tokens last, as the paper's conditions have them: "rgb+tacff" for "tacff+rgb"."""
    touch = list(TACTILE_TOKENS)
    return "+".join(sorted(obs_mode.split("+"), key=lambda token: touch.index(token) if token in touch else -1))


def split_obs_mode(obs_mode: str) -> tuple[str, tuple[str, ...]]:
    """Split `obs_mode` into ManiSkill's own part ("none" if nothing is left) and the tactile outputs asked for.

    Raises:
        InvalidArgumentError: A token is unknown, repeated, or cannot be joined with others.
    """
    tokens = str(obs_mode).split("+")
    known = (*TACTILE_TOKENS, *ALL_VISUAL_TEXTURES, *STATE_TOKENS, *WHOLE_MODES)
    for token in tokens:
        if token not in known:
            raise InvalidArgumentError(f"obs_mode={obs_mode!r}: token {token!r} is unknown; join any of {list(known)} by '+'")
    if "rgbd" in tokens and (twice := {"rgb", "depth"} & set(tokens)):
        raise InvalidArgumentError(f"obs_mode={obs_mode!r}: 'rgbd' is 'rgb+depth', so that {sorted(twice)} is given twice")
    if repeated := {token for token in tokens if tokens.count(token) > 1}:
        raise InvalidArgumentError(f"obs_mode={obs_mode!r}: token {sorted(repeated)} is given more than once")
    if set(STATE_TOKENS) <= set(tokens):
        raise InvalidArgumentError(f"obs_mode={obs_mode!r}: 'state' and 'state_dict' are two forms of one state; choose one")
    own = ["rgb+depth" if token == "rgbd" and len(tokens) > 1 else token for token in tokens if token not in TACTILE_TOKENS]
    alone = [token for token in own if token in WHOLE_MODES]
    if alone and len(tokens) > 1 and own != ["pointcloud"]:
        raise InvalidArgumentError(
            f"obs_mode={obs_mode!r}: {alone[0]!r} cannot be joined with these; join 'rgb', 'depth', ... with touch instead"
        )
    touch = tuple(output for token, output in TACTILE_TOKENS.items() if token in tokens)
    return "+".join(own) or "none", touch


def cameras_to_observe(obs_mode: str, cameras: Any, known: Iterable[str]) -> tuple[str, ...]:
    """The names of the cameras that an environment renders; warns if there is none although images are asked for.

    Args:
        obs_mode: Observation mode of the environment.
        cameras: The argument of that name: one camera, or several.
        known: Cameras that the task has.

    Raises:
        InvalidArgumentError: The task has no such camera.
    """
    names = several_of("cameras", cameras, known)
    if not names and has_images(split_obs_mode(obs_mode)[0]):
        log.warning("obs_mode=%r observes images, but cameras names no camera, so that images are missing", obs_mode)
    return names


def pads_to_observe(obs_mode: str, tactile_sensors: Any, sides: Iterable[str]) -> tuple[str, ...]:
    """The sides of the pads that an environment observes; warns if there is none although touch is asked for.

    It is no error, because ManiSkill's tools replay files that were recorded without pads in any observation mode.

    Args:
        obs_mode: Observation mode of the environment.
        tactile_sensors: The argument of that name: one side, or several.
        sides: Sides that the robot has.

    Raises:
        InvalidArgumentError: The robot has no such side.
    """
    pads = several_of("tactile_sensors", tactile_sensors, sides)
    if not pads and split_obs_mode(obs_mode)[1]:
        log.warning("obs_mode=%r observes touch, but tactile_sensors names no pad, so that touch is missing", obs_mode)
    return pads
