"""Record demonstrations by hand, in a browser: `python -m manifeel_ms3.teleop ManiFeel-USBInsertion-v1`. Needs the extra
`teleop`."""

import logging
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from manifeel_ms3.agents.panda_gelsight import ACTION_AXES
from manifeel_ms3.command_line import json_object, run
from manifeel_ms3.tasks.registry import make_env

from .devices import DEVICES, follow
from .operator import Operator
from .session import Session

log = logging.getLogger(__name__)


@dataclass
class Args:
    env_id: tyro.conf.Positional[str]
    """task, such as ManiFeel-USBInsertion-v1"""
    out: Path | None = None
    """trajectory file; what is in it stays; default data/demos/<task>/human.h5"""
    obs_mode: str = "rgb+tacrgb+tacff"
    """what is shown and recorded"""
    cameras: tuple[str, ...] | None = None
    """default: the task's policy camera"""
    tactile_sensors: tuple[str, ...] = ("right",)
    seed: int = 0
    """of the first episode"""
    env_kwargs: str = "{}"
    """further arguments of the task as json"""
    device: Literal["spacemouse", "gamepad"] | None = None
    """steer with it, besides the page"""
    host: str = "localhost"
    """address to listen on; anybody who reaches it can watch, and the first steers"""
    port: int = 8080


def main(args: Args) -> Path:
    """Record until interrupted; returns the file's path.

    Raises:
        DemonstrationError: the file was recorded with other settings.
        DeviceError: the device is not there.
        ModuleNotFoundError: viser is not installed.
    """
    try:
        from .page import Page
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("the page is made with viser: pip install 'manifeel-ms3[teleop]'") from error
    kwargs = dict(obs_mode=args.obs_mode, sim_backend="physx_cpu", tactile_sensors=list(args.tactile_sensors))
    if args.cameras is not None:
        kwargs["cameras"] = list(args.cameras)
    kwargs |= json_object("--env-kwargs", args.env_kwargs)
    env = make_env(args.env_id, **kwargs)
    operator = Operator(ACTION_AXES[env.unwrapped.control_mode])
    if args.device:
        follow(DEVICES[args.device](), operator)
    out = args.out or Path("data/demos") / args.env_id / "human.h5"
    session = Session(env, args.env_id, kwargs, out, args.seed, operator)
    page = Page(operator, args.env_id, args.host, args.port)
    log.info("%s shows the robot; Ctrl-C ends it. Episodes go to %s", page.address, out)
    try:
        session.run(page)
    except KeyboardInterrupt:
        log.info("ended; what was saved is in %s", out)
    finally:
        session.finish()
        page.stop()
        env.close()
    return out


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args)))
