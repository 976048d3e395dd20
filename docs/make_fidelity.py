"""The page docs/fidelity.md, made anew: `python -m docs.make_fidelity` in the repository's root.

What the code knows is read from it: the tasks' registry, the start ranges and the presets. The other rows are those of
docs/fidelity.yaml. A test fails where the page is not what this makes.
"""

import dataclasses
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from baselines.common.train_args import TrainArgs
from baselines.registry import all_policies
from manifeel_ms3.agents.panda_gelsight import ACTION_AXES
from manifeel_ms3.analysis.markdown import markdown_table
from manifeel_ms3.analysis.paper import training_demos
from manifeel_ms3.files import write_text
from manifeel_ms3.rendering.cameras import FIELD_OF_VIEW, IMAGE_SIZE
from manifeel_ms3.tasks import scenery
from manifeel_ms3.tasks import visuotactile_env as env
from manifeel_ms3.tasks.insertion import base as insertion
from manifeel_ms3.tasks.insertion.base import InsertionEnv
from manifeel_ms3.tasks.registry import TaskSpec, all_tasks
from manifeel_ms3.tasks.screwing import base as screwing
from manifeel_ms3.tasks.screwing.base import ScrewingEnv

Row = tuple[str, str, str, str, str, str]
"""What is compared, the paper, its public code, ours, "same" or "different", and why."""
PAGE = Path(__file__).with_name("fidelity.md")
ROWS = Path(__file__).with_name("fidelity.yaml")
CODE_LIMIT = 500
"""Time limit of every task in the paper's public code, in control steps."""
RECORDED = {
    "PegInsertion": 50,
    "USBInsertion": 50,
    "PowerPlugInsertion": 50,
    "GearAssembly": 100,
    "NutBoltAssembly": 30,
    "BulbInstallation": 20,
    "PegReorientation": 50,
    "ObjectSearch": 50,
    "BallSorting": 80,
    "BallSortingDim": 80,
}
"""Number of demonstrations that the paper recorded of each task (its summary of the data)."""
CAMERAS = dict(insertion="wrist", screwing="wrist", exploration="front")
"""Camera that the paper's policies look through, by the category of the task."""
ACTIONS = {"NutBoltAssembly": 7, "BulbInstallation": 7, "ObjectSearch": 7, "BallSorting": 7, "BallSortingDim": 7}
"""Size of the paper's actions where the gripper is part of them (its summary of the data); 6 elsewhere."""
USED_ACTIONS = {"NutBoltAssembly": 6, "BulbInstallation": 6}
"""Size of the paper's actions where its table of set-ups and its summary of the data differ."""
WHY_WITH_GRIPPER = "The paper's two numbers contradict each other. Here, the hand lets go and grasps again to screw."
TOLERANCE = 1e-3
"""Difference of two half ranges, in m or rad, that comes from rounding."""
INSERTION_RANGES = dict(socket_xy=0.05, start_xy=0.1, start_z=0.05, start_rotation=0.1, in_hand_pitch=0.175)
REORIENTATION_RANGES = dict(socket_xy=0.0, start_xy=0.1, start_z=0.05, start_rotation=0.05, in_hand_pitch=0.524, start_yaw=0.5)
NUT_RANGES = dict(fixed_xy=0.02, start_xy=0.0, start_z=0.0)
BULB_RANGES = dict(fixed_xy=0.05, start_xy=0.0, start_z=0.0)
SORTING_RANGES = dict(stand_xy=0.05, start_xy=0.0, start_z=0.0)
CODE_RANGES = {
    "NutBoltAssembly": NUT_RANGES,
    "BulbInstallation": BULB_RANGES,
    "PegReorientation": REORIENTATION_RANGES,
    "ObjectSearch": dict(place_xy=0.0, start_xy=0.0, start_z=0.0),
    "BallSorting": SORTING_RANGES,
    "BallSortingDim": SORTING_RANGES,
}
"""Half ranges of the paper's public code, in m and rad; INSERTION_RANGES for the other tasks."""
OF_OTHER_STARTS = ("screw_depth",)
"""Half ranges that have an effect only with other starts than the default, such as `start="holder"`; they are not compared."""
CODE_HEIGHTS = dict(
    NutBoltAssembly=0.12, BulbInstallation=0.12, PegReorientation=0.22, ObjectSearch=0.07, BallSorting=0.12, BallSortingDim=0.12
)
"""Height of the tool at the start in the public code, in m; 0.15 for the other tasks."""
SAMPLERS = {"diffusion_policy": "ddpm", "equivariant_diffusion_policy": "ddim"}
SETTINGS: dict[str, tuple[Any, Any]] = {  # setting: (paper, public code); "" where it says nothing
    "policy.obs_horizon": (2, 2),
    "policy.action_horizon": (8, 8),
    "policy.pred_horizon": (16, 16),
    "image_size": (256, 256),
    "tactile_image_size": (256, 256),
    "pose": ("quaternion", "quaternion"),
    "batch_size": (8, 8),
    "lr": (8e-5, {"diffusion_policy": 8e-5, "equivariant_diffusion_policy": 1e-4, "flow_matching": 1e-4}),
    "inference_steps": (100, 100),
    "policy.diffusion_steps": (100, 100),
    "policy.prediction": ("", {"diffusion_policy": "epsilon", "equivariant_diffusion_policy": "sample"}),
    "policy.sampler": (SAMPLERS, SAMPLERS),
    "policy.down_dims": ("", (512, 1024, 2048)),
    "policy.kernel_size": ("", 5),
    "policy.n_groups": ("", 8),
    "policy.diffusion_step_embed_dim": ("", 128),
    "policy.encoder.crop": ("", {"diffusion_policy": 0, "equivariant_diffusion_policy": 230, "flow_matching": 0}),
    "policy.encoder.image_features": ("", {"diffusion_policy": 512, "flow_matching": 512}),
    "policy.encoder.tactile_features": (
        "",
        {"diffusion_policy": 512, "equivariant_diffusion_policy": 128, "flow_matching": 512},
    ),
    "betas": ("", (0.95, 0.999)),
    "weight_decay": ("", 1e-6),
    "warmup_steps": ("", 500),
    "ema_power": ("", 0.75),
    "ema_max_decay": ("", 0.9999),
}
WHY_SETTINGS = {
    "lr": "Paper and code differ; the tables were most likely measured with the code.",
    "pose": "The equivariant policy of the code rotates two columns of the rotation matrix.",
}
OVER_SOCKET = "At the code's height the plug could start inside its socket."
WHY_STARTS = {
    "NutBoltAssembly": "The range is the paper's.",
    "USBInsertion": OVER_SOCKET,
    "PowerPlugInsertion": OVER_SOCKET,
    "GearAssembly": "At the code's height, the gear could start as little as 4 mm above the shafts.",
    "ObjectSearch": "Without this variation, the fifty evaluation episodes would have only two different initial states.",
}
"""Why starts differ from the code's."""
HEAD = """# Fidelity to the paper and its public code

*Made by `python -m docs.make_fidelity` from the registry of tasks, the presets and docs/fidelity.yaml.*

This package reimplements the benchmark of the paper ManiFeel ([Luu et al. 2025](https://arxiv.org/abs/2505.18472)). This page
says, row by row, what is the same as in the paper and in its public code (purdue-mars/manifeel, commit e80b1f4), what is
different, and why. Where the paper says nothing, the comparison is with the code. Of {total} rows, {same} are the same and
{different} differ.
"""
NAMES = ("", "paper", "public code", "here", "", "why")


def main() -> None:
    """Write the page."""
    write_text(PAGE, "".join(page()))


def page() -> Iterator[str]:
    """The Markdown page, part by part."""
    from_the_code = {
        "Demonstrations, camera and actions": task_rows(),
        "Time limits": limit_rows(),
        "Initial states: half ranges in m and rad, and heights": start_rows(),
        "Settings of the policies' preset `paper`": setting_rows(),
    }
    sections = {title: list(rows) for title, rows in from_the_code.items()} | written_rows()
    verdicts = [row[4] for rows in sections.values() for row in rows]
    yield HEAD.format(total=len(verdicts), same=verdicts.count("same"), different=verdicts.count("different"))
    for title, rows in sections.items():
        yield f"\n## {title}\n\n"
        yield markdown_table(NAMES, rows)


# -------------------------------------------------------------------- from the code


def paper_tasks() -> list[TaskSpec]:
    """The tasks of the paper, in its order."""
    return [spec for spec in all_tasks().values() if spec.name in RECORDED]


def task_rows() -> Iterator[Row]:
    """A row on each task: demonstrations, camera and size of the actions."""
    for spec in paper_tasks():
        trained_on = f"{training_demos(spec.name)} used for training"
        theirs = f"{RECORDED[spec.name]} recorded, {trained_on}; {CAMERAS[spec.category]}; {ACTIONS.get(spec.name, 6)} numbers"
        why = ""
        if used := USED_ACTIONS.get(spec.name):
            theirs += f" in the data, {used} in the experiments"
            why = WHY_WITH_GRIPPER
        size = len(ACTION_AXES[spec.env_class.default_control_mode])
        ours = f"{spec.paper_demos} recorded, {trained_on}; {spec.policy_camera}; {size} numbers"
        yield _row(spec.name, theirs, "", ours, why)


def limit_rows() -> Iterator[Row]:
    """A row on the time limit of each task."""
    why = (
        "At least twice the mean length of the paper's number of demonstrations, and 1.5 times the longest of them: the code's "
        "limit would leave no margin in the longest tasks, and rewards waiting in the others."
    )
    for spec in paper_tasks():
        yield _row(spec.name, "", f"{CODE_LIMIT} steps", f"{spec.max_episode_steps} steps", why)


def start_rows() -> Iterator[Row]:
    """Rows on the height of the tool at the start of each task, and on the half ranges of what is random."""
    for spec in paper_tasks():
        fields = (field for field in dataclasses.fields(spec.env_class.Randomization) if field.name not in OF_OTHER_STARTS)
        ours: dict[str, Any] = {field.name: field.default for field in fields}
        theirs = CODE_RANGES.get(spec.name, INSERTION_RANGES)
        shown = [", ".join(f"{name} {value:.3g}" for name, value in ranges.items()) for ranges in (theirs, ours)]
        same = all(abs(ours.get(name, 0.0) - theirs.get(name, 0.0)) < TOLERANCE for name in ours.keys() | theirs.keys())
        yield spec.name, "", shown[0], shown[1], _verdict(same), "" if same else WHY_STARTS.get(spec.name, "")
    for spec in paper_tasks():
        heights = (CODE_HEIGHTS.get(spec.name, 0.15), start_height(spec))
        there, here = (f"tool {height * 1000:.0f} mm above the table" for height in heights)
        yield _row(spec.name, "", there, here, WHY_STARTS.get(spec.name, ""))


def start_height(spec: TaskSpec) -> float:
    """Nominal height of the tool over the table at the start of a task, in m."""
    if issubclass(spec.env_class, InsertionEnv):
        return insertion.START_XYZ[2] + spec.env_class.lift
    if issubclass(spec.env_class, ScrewingEnv):
        return screwing.START_Z
    return sys.modules[spec.env_class.__module__].START_XYZ[2]


def setting_rows() -> Iterator[Row]:
    """Rows on each setting of the preset `paper` of every policy that the paper reports."""
    for setting, (paper, code) in SETTINGS.items():
        presets = {name: spec.presets["paper"].args for name, spec in all_policies().items() if "paper" in spec.presets}
        ours = {name: value for name, args in presets.items() if (value := _value(args, setting)) is not None}
        expected = code if isinstance(code, dict) else dict.fromkeys(ours, code)
        differing = [name for name, value in ours.items() if name in expected and value != expected[name]]
        why = WHY_SETTINGS.get(setting, "")
        same = not differing and (paper == "" or paper == code)
        yield f"`{setting}`", _shown(paper), _shown(code), _shown(ours), _verdict(same), "" if same else why


def _value(args: Any, setting: str) -> Any:
    """A setting of a preset; a learning rate that is left open is the one that training then takes."""
    value = args
    for part in setting.split("."):
        value = getattr(value, part, None)
    return args.public_code_lr() if setting == "lr" and value is None else value


def _shown(values: Any) -> str:
    """One value, or one for each policy where they differ."""
    if not isinstance(values, dict):
        return json.dumps(values) if isinstance(values, tuple) else f"{values:g}" if isinstance(values, float) else str(values)
    if len({_shown(value) for value in values.values()}) == 1:
        return _shown(next(iter(values.values())))
    return ", ".join(f"{_shown(value)} ({name})" for name, value in values.items())


def _row(what: str, paper: str, code: str, here: str, why: str = "") -> Row:
    same = here in (paper, code)
    return what, paper, code, here, _verdict(same), "" if same else why


def _verdict(same: bool) -> str:
    return "same" if same else "different"


# -------------------------------------------------------------------- written by hand


def written_rows() -> dict[str, list[Row]]:
    """The rows of docs/fidelity.yaml by their sections, with what they read from the code."""
    sections = yaml.safe_load(ROWS.read_text(encoding="utf-8"))
    values = read_from_the_code()
    return {title: [_written(row, values) for row in rows] for title, rows in sections.items()}


def _written(row: dict[str, Any], values: dict[str, Any]) -> Row:
    return row["what"], row["paper"], row["code"], row["here"].format(**values), _verdict(row["same"]), row.get("why", "")


def read_from_the_code() -> dict[str, Any]:
    """What rows of docs/fidelity.yaml can name in braces."""
    return dict(
        control_freq=env.CONTROL_FREQ,
        hold=env.HOLD_SECONDS,
        image_size=IMAGE_SIZE,
        field_of_view=np.rad2deg(FIELD_OF_VIEW),
        dim=scenery.LIGHTING["dim"],
        save_freq=TrainArgs(demos=()).save_freq,
    )


if __name__ == "__main__":
    main()
