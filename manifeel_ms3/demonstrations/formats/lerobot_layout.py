"""Where LeRobot's datasets (format 3.0) keep things, and the names of their features."""

from manifeel_ms3.tasks.obs_modes import PAD, POSE

INFO = "meta/info.json"
"""File that describes a dataset; a folder without it is none."""
ORIGIN = "meta/manifeel.json"
"""File beside LeRobot's own that names the task and its arguments, with which policies are evaluated."""
CARD = "README.md"
"""File of the dataset's card."""
DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
"""Paths of the files in LeRobot's layout 3.0. The layout that a data set describes is compared and never filled in, because a
description can name any file."""
POSE_AXES = ["x", "y", "z", "qw", "qx", "qy", "qz"]
"""Names of the components of `observation.state`, the pose of the tool."""
COUNTERS = ("frame_index", "episode_index", "index", "task_index")
"""Features that number frames, episodes and tasks; every LeRobot dataset has them."""


def feature_name(key: str) -> str:
    """LeRobot's name of an observation.

    Images are `observation.images.<camera>` and `observation.images.tactile_<side>`, which policies of LeRobot take like any
    other image. Force fields are `observation.tactile.<side>.force_field`.

    Args:
        key: Key of the observation, such as "sensor_data/wrist/rgb", "sensor_data/tactile_right/force_field", "extra/tcp_pose".
    """
    if key == POSE:
        return "observation.state"
    _, sensor, kind = key.split("/")
    return f"observation.images.{sensor}" if kind == "rgb" else f"observation.tactile.{sensor.removeprefix(PAD)}.{kind}"


def earlier_feature_name(key: str) -> str:
    """The name of an observation in datasets that version 0.1.0 exported."""
    if key == POSE or key.endswith("/rgb"):
        return feature_name(key)
    _, sensor, kind = key.split("/")
    return f"observation.{kind}.{sensor}"
