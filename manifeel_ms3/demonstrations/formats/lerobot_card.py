"""The card of an exported LeRobot dataset: the README.md that the Hub shows."""

import json
from typing import Any

from manifeel_ms3.sensors.config import Units
from manifeel_ms3.sensors.registry import DEFAULT_SENSOR
from manifeel_ms3.tasks.obs_modes import PAD

from .lerobot_layout import feature_name
from .maniskill_h5 import origins, task_of, versions_of
from .touch_units import MEANING, recorded_units

FRONT = """---
license: apache-2.0
task_categories:
- robotics
tags:
- LeRobot
- tactile
- simulation
configs:
- config_name: default
  data_files: data/*/*.parquet
---

# {env_id}

**Task:** {task}

{episodes} demonstrations with {frames} frames at {fps} Hz, made in simulation with
manifeel_ms3 {version} (revision {revision} of the task), by: {source}.
The dataset has LeRobot's format {form}.

| Feature | Type | Shape | Components |
|---|---|---|---|
"""
BACK = """
`observation.state` is the pose of the tool in the robot's base frame (m, quaternion wxyz). {images}{touch}Actions are those
of the control mode `{control_mode}`. `next.reward`, `next.success` and `next.done` are those
after the frame's action.

The task was made with these arguments:

```json
{env_kwargs}
```
"""


def card(header: dict[str, Any], keys: list[str], task: str, info: dict[str, Any]) -> str:
    """The text of the card.

    Args:
        header: The json beside the trajectory file.
        keys: Keys of the observations in the trajectory file.
        task: Sentence of the task.
        info: The content of meta/info.json.

    Raises:
        UnknownNameError: The sensor is of a package that is not installed, or a field is unknown.
        InvalidArgumentError: An argument of the pads is not allowed.
    """
    about = dict(
        env_id=task_of(header),
        task=task,
        episodes=info["total_episodes"],
        frames=info["total_frames"],
        fps=info["fps"],
        version=(versions_of(header) or {}).get("manifeel-ms3", "of unknown version"),
        revision=header.get("revision", "not known"),
        source="; ".join(str(source or "a source that is not named") for source in origins(header, "source_desc")),
        form=info["codebase_version"],
    )
    rows = [
        f"| `{name}` | {feature['dtype']} | {' x '.join(map(str, feature['shape']))} | {', '.join(feature['names'] or ())} |\n"
        for name, feature in info["features"].items()
    ]
    env_kwargs = header["env_info"]["env_kwargs"]
    back = BACK.format(
        env_kwargs=json.dumps(env_kwargs, indent=2),
        images=_images(header, info),
        touch=_touch(recorded_units(env_kwargs, keys)),
        control_mode=", ".join(sorted({episode.get("control_mode", "not named") for episode in header["episodes"]})),
    )
    return FRONT.format(**about) + "".join(rows) + back


def _images(header: dict[str, Any], info: dict[str, Any]) -> str:
    """A sentence that says what the tactile images are; "" if there are none."""
    sensor = header["env_info"]["env_kwargs"].get("sensor", DEFAULT_SENSOR)
    named = ", ".join(f"`{name}`" for name in info["features"] if name.startswith(feature_name(f"sensor_data/{PAD}/rgb")))
    return f"{named}: images of the gel of the sensor `{sensor}`, as one sees its face from outside.\n" if named else ""


def _touch(units: dict[str, Units]) -> str:
    """Sentences that say what the force fields of the pads are."""
    named = {feature_name(f"sensor_data/{pad}/force_field"): MEANING[unit] for pad, unit in units.items()}
    return "".join(f"`{name}` holds {meaning}.\n" for name, meaning in named.items())
