"""The paper's conditions and the numbers that it reports of them.

A success rate is the mean over the last 10 checkpoints, 50 evaluation episodes and 3 training seeds. Which tasks a table
reports is given by the tasks themselves (`TaskSpec.paper_tables`); the numbers are here, by the tasks' short names.

The paper contradicts itself on ball sorting. Its list of set-ups has dim light alone for Tables I to III, and its text on Table
II speaks of "dimly lit sorting"; but Tables I and II report different rates for the same policies, 57, 72 and 60 % in Table I
("dim"), 43, 73 and 50 % in Table II (no light named). Here, Tables II and III are therefore run in both lights.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass

from manifeel_ms3.tasks.registry import full_id, short_name, task_spec, tasks_of_table

from .condition import Condition

VISION, TACRGB, TACFF = "rgb", "rgb+tacrgb", "rgb+tacff"
MODES = (VISION, TACRGB, TACFF)
"""Observation modes in the order of the paper's columns."""
DP, EQUIDP, FM = "diffusion_policy", "equivariant_diffusion_policy", "flow_matching"
"""Registered names of the paper's policies."""
SCRATCH = "resnet18"
"""Encoder of TacRGB that is trained from scratch, the same network as that of the cameras."""
DIM, YAW, TACSL = dict(lighting="dim"), dict(control_mode="pd_ee_delta_yaw"), dict(tactile=dict(units="tacsl"))
"""Arguments of tasks: dim light; actions that turn about the vertical alone (5-D); TacFF in the units of the paper's sensor."""


@dataclass(frozen=True)
class Rate:
    """A success rate of the paper."""

    mean: float
    """Mean over training seeds, checkpoints and episodes."""
    deviation: float
    """Standard deviation over training seeds."""

    def __str__(self) -> str:
        return f"{self.mean:.0%} ± {self.deviation:.0%}".replace("% ±", " ±")


def _rates(*numbers: tuple[float, float]) -> tuple[Rate, ...]:
    return tuple(Rate(*pair) for pair in numbers)


TABLE_I = {
    "PegInsertion": _rates((0.14, 0.01), (0.21, 0.02), (0.40, 0.02)),
    "USBInsertion": _rates((0.49, 0.03), (0.49, 0.02), (0.56, 0.01)),
    "PowerPlugInsertion": _rates((0.51, 0.02), (0.51, 0.01), (0.58, 0.02)),
    "GearAssembly": _rates((0.63, 0.02), (0.57, 0.02), (0.66, 0.01)),
    "NutBoltAssembly": _rates((0.80, 0.03), (0.78, 0.03), (0.81, 0.03)),
    "BulbInstallation": _rates((0.76, 0.02), (0.72, 0.04), (0.81, 0.02)),
    "PegReorientation": _rates((0.29, 0.02), (0.39, 0.02), (0.28, 0.02)),
    "ObjectSearch": _rates((0.52, 0.04), (0.69, 0.01), (0.52, 0.02)),
    "BallSortingDim": _rates((0.57, 0.03), (0.72, 0.02), (0.60, 0.02)),
}
"""Table I: success of Diffusion Policy with ResNet-18 from scratch, by task, in the order of MODES."""
_SORTING_BY_POLICY = {
    DP: _rates((0.43, 0.03), (0.73, 0.03), (0.50, 0.03)),
    EQUIDP: _rates((0.21, 0.03), (0.46, 0.02), (0.31, 0.04)),
    FM: _rates((0.41, 0.03), (0.69, 0.01), (0.43, 0.03)),
}
TABLE_II = {
    "GearAssembly": {
        DP: _rates((0.63, 0.02), (0.57, 0.02), (0.66, 0.01)),
        EQUIDP: _rates((0.70, 0.02), (0.66, 0.02), (0.74, 0.03)),
        FM: _rates((0.38, 0.01), (0.37, 0.01), (0.39, 0.02)),
    },
    "BulbInstallation": {
        DP: _rates((0.76, 0.02), (0.72, 0.04), (0.81, 0.02)),
        EQUIDP: _rates((0.94, 0.01), (0.94, 0.01), (0.95, 0.02)),
        FM: _rates((0.60, 0.03), (0.63, 0.03), (0.66, 0.02)),
    },
    "ObjectSearch": {
        DP: _rates((0.52, 0.04), (0.69, 0.01), (0.52, 0.02)),
        EQUIDP: _rates((0.44, 0.08), (0.67, 0.04), (0.46, 0.07)),
        FM: _rates((0.16, 0.03), (0.44, 0.03), (0.15, 0.03)),
    },
    "BallSortingDim": _SORTING_BY_POLICY,
    "BallSorting": _SORTING_BY_POLICY,
}
"""Table II: success by task and policy, in the order of MODES; ball sorting in both lights."""
_SORTING_BY_ENCODER = dict(resnet18=Rate(0.73, 0.03), unit=Rate(0.80, 0.05), t3=Rate(0.68, 0.01), anytouch=Rate(0.74, 0.02))
TABLE_III = {
    "GearAssembly": dict(resnet18=Rate(0.57, 0.02), unit=Rate(0.61, 0.01), t3=Rate(0.57, 0.02), anytouch=Rate(0.28, 0.02)),
    "ObjectSearch": dict(resnet18=Rate(0.69, 0.01), unit=Rate(0.58, 0.03), t3=Rate(0.71, 0.03), anytouch=Rate(0.59, 0.02)),
    "BallSortingDim": _SORTING_BY_ENCODER,
    "BallSorting": _SORTING_BY_ENCODER,
}
"""Table III: success of Diffusion Policy with TacRGB, by task and encoder; ball sorting in both lights."""
MOST_DEMOS = 50
"""Largest number of training episodes in Tables I to III; of some tasks, more were recorded."""
SATURATION_DEMOS = 80
"""Number of training episodes near which success saturates on gear assembly, in all three sensings."""
TWIN_DEMOS = {"GearAssembly": 80, "BulbInstallation": 20, "BallSorting": 80, "BallSortingDim": 80}
"""Number of training episodes in the paper's simulated twin of its real set-ups, by task."""
TWIN_VARIANTS = {"BulbInstallation": YAW}
"""Arguments of the twin's tasks: gear has 6-D actions, the bulb 5-D, sorting 7-D."""
REAL_RATES = {
    "GearAssembly": {VISION: 0.33, TACFF: 0.47},
    "BulbInstallation": {TACFF: 0.73},
    "BallSorting": {VISION: 0.33, TACRGB: 0.80},
}
"""Success on the paper's real robot, as far as the text on its figure gives numbers."""
TWIN_RATES = {"BulbInstallation": {TACFF: 0.81}, "BallSorting": {VISION: 0.70, TACRGB: 0.85}}
"""Success in the paper's simulated twin of its real set-ups, as far as the same text gives numbers."""
SIMILARITY = {
    "tacrgb": {"ball": (5.67, 0.0579), "bulb": (5.80, 0.0646), "gear": (6.57, 0.0744)},
    "tacff": {"ball": (2.96, 0.0277), "bulb": (3.54, 0.0323), "gear": (2.91, 0.0254)},
}
"""Distances of simulated to real tactile images, FID and KID, by modality and object; the paper does not name its ResNet."""
RUNTIME = dict(resnet18=8.1, unit=25.8, t3=17.7, anytouch=66.3)
"""Time of training for one epoch in minutes, by encoder of TacRGB: NVIDIA A30, batch size 8, real sorting in normal light."""
RUNTIME_DEMOS = 103
"""Number of demonstrations of the runtime comparison."""


def training_demos(task: str) -> int:
    """Number of training episodes of a task in Tables I to III."""
    return min(task_spec(task).paper_demos, MOST_DEMOS)


def paper_condition(
    task: str,
    mode: str,
    policy: str = DP,
    camera: str | None = None,
    num_demos: int | None = None,
    encoder: str = SCRATCH,
    variant: dict | None = None,
) -> Condition:
    """A condition of the paper, without its settings.

    Args:
        task: Short name of the task.
        mode: Observation mode, one of MODES.
        policy: Registered name of the policy.
        camera: Camera that the policy observes; the task's policy camera if not given.
        num_demos: Number of training episodes; that of Tables I to III if not given.
        encoder: Encoder of TacRGB images.
        variant: Arguments of the task other than its defaults.
    """
    spec = task_spec(full_id(task))
    return Condition(
        spec.env_id,
        mode,
        policy,
        encoder if mode == TACRGB else "",
        (camera or spec.policy_camera,),
        () if mode == VISION else ("right",),
        num_demos or training_demos(task),
        json.dumps(variant, sort_keys=True) if variant else "",
        spec.revision,
    )


def twin_condition(task: str, mode: str) -> Condition:
    """A condition of the paper's simulated twin of its real set-ups; Diffusion Policy.

    Args:
        task: Short name of the task, one of TWIN_DEMOS.
        mode: Observation mode, one of MODES.
    """
    return paper_condition(task, mode, num_demos=TWIN_DEMOS[task], variant=TWIN_VARIANTS.get(task))


def tasks_in_table(table: str, *categories: str) -> list[str]:
    """Short names of the tasks that a table of the paper reports, in the paper's order.

    Args:
        table: Number of the table: "I", "II" or "III".
        categories: Categories of the tasks; all of them if none is given.
    """
    env_ids = tasks_of_table(table)
    return [short_name(env_id) for env_id in env_ids if not categories or task_spec(env_id).category in categories]


def reported() -> Iterator[tuple[str, Condition, Rate]]:
    """Every success rate of the paper's tables: number of the table, condition, and rate."""
    for task in tasks_in_table("I"):
        for mode, rate in zip(MODES, TABLE_I[task], strict=True):
            yield "I", paper_condition(task, mode), rate
    for task in tasks_in_table("II"):
        for policy, rates in TABLE_II[task].items():
            for mode, rate in zip(MODES, rates, strict=True):
                yield "II", paper_condition(task, mode, policy), rate
    for task in tasks_in_table("III"):
        for encoder, rate in TABLE_III[task].items():
            yield "III", paper_condition(task, TACRGB, encoder=encoder), rate
