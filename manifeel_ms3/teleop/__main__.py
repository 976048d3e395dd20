"""Record demonstrations by hand, in a browser: `manifeel teleop ManiFeel-USBInsertion-v1`.

Needs the extra `teleop`.
"""

import logging
import sys
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import gymnasium as gym
import tyro

from manifeel_ms3.command_line import json_object, missing_extras_named, run
from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.network import LOOPBACK_NAMES
from manifeel_ms3.tasks.registry import make_env, task_spec

from .devices import DEVICES, follow
from .operator import Operator, steerable_axes
from .session import Session

if TYPE_CHECKING:
    from .page import Page

log = logging.getLogger(__name__)
LAST_PORT = 2**16 - 1
"""Largest number of a port (TCP)."""


@dataclass
class Args:
    """Arguments of the command."""

    env_id: tyro.conf.Positional[str]
    """Id of the task, such as ManiFeel-USBInsertion-v1, or its short name, such as USBInsertion."""
    out: Path | None = None
    """Path of the trajectory file, to which episodes are added; data/demos/<task>/human.h5 if not given."""
    obs_mode: str = "rgb+tacrgb+tacff"
    """Observations to show and record, joined by "+"."""
    cameras: tuple[str, ...] | None = None
    """Cameras to show and record; the camera of the task's policies if not given."""
    tactile_sensors: tuple[str, ...] = ("right",)
    """Sides of the tactile sensors to show and record."""
    seed: int = 0
    """Seed of the first episode; if the file holds a seed that is not smaller, the one after the largest in the file."""
    env_kwargs: str = "{}"
    """Further arguments of the task as json, such as '{"fit": "tight"}'."""
    device: Literal["spacemouse", "gamepad"] | None = None
    """Device to steer with, besides the page; none if not given."""
    host: str = "localhost"
    """Address to listen on. Whoever has the page's address, which holds a token, can watch, and the first to open it steers."""
    port: int = 8080
    """Port to listen on; the next free one if it is taken."""


def main(args: Args) -> Path:
    """Record until interrupted, and return the path of the trajectory file.

    Raises:
        UnknownNameError: The task is not registered.
        InvalidArgumentError: The control mode cannot be steered, there is nothing to show, or an argument is not allowed.
        DemonstrationError: The file was recorded with other arguments.
        DeviceError: The device cannot be used.
        MissingExtraError: viser, which serves the page, is not installed.
    """
    if not 1 <= args.port <= LAST_PORT:  # the system would take it modulo 65536
        raise InvalidArgumentError(f"--port {args.port} is not a port; give a number from 1 to {LAST_PORT}, such as 8080")
    with missing_extras_named():
        from .page import Page
    args = replace(args, env_id=task_spec(args.env_id).env_id)
    kwargs: dict[str, Any] = dict(obs_mode=args.obs_mode, sim_backend="physx_cpu", tactile_sensors=list(args.tactile_sensors))
    if args.cameras is not None:
        kwargs["cameras"] = list(args.cameras)
    kwargs |= json_object("--env-kwargs", args.env_kwargs)
    env = make_env(args.env_id, **kwargs)
    base: Any = env.unwrapped
    operator = Operator(steerable_axes(base.control_mode))
    if args.device:
        follow(DEVICES[args.device](), operator)
    out = args.out or Path("data/demos") / args.env_id / "human.h5"
    with ExitStack() as stack:
        stack.callback(env.close)
        _require_images(env, kwargs["obs_mode"])
        page = Page(operator, args.env_id, args.host, args.port, base.touch_full_scales)
        stack.callback(page.stop)
        session = Session(env, args.env_id, kwargs, out, args.seed, operator)  # takes the file apart until it is finished
        stack.callback(session.finish)
        _record(session, page, args, out)
    return out


def _record(session: Session, page: "Page", args: Args, out: Path) -> None:
    """Say where the page is, and record until interrupted."""
    if args.host not in LOOPBACK_NAMES:
        log.warning(
            "--host %s: other machines reach the page. Whoever has the address below can watch and steer the robot, and "
            "whoever listens on the network can read it, because the connection is not encrypted",
            args.host,
        )
    log.info("%s shows the robot; Ctrl-C ends it. Episodes go to %s", page.address, out)
    try:
        session.run(page)
    except KeyboardInterrupt:
        log.info("ended; %s", f"what was saved is in {out}" if session.num_saved else "nothing was saved")


def _require_images(env: gym.Env, obs_mode: str) -> None:
    """Check that the observations hold something for the page to show, without which nobody can steer.

    Raises:
        InvalidArgumentError: They hold neither images nor force fields.
    """
    space: Any = env.observation_space
    sensors: Any = space.get("sensor_data", {}) if isinstance(space, gym.spaces.Dict) else {}
    if not any({"rgb", "force_field"} & data.keys() for data in sensors.values()):
        raise InvalidArgumentError(
            f"the page has nothing to show with --obs-mode {obs_mode} and these cameras and pads; add rgb, tacrgb or tacff"
        )


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args)))
