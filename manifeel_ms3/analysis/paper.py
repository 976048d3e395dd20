"""The paper's conditions and the numbers that it reports of them.

A success rate is the mean over the last 10 checkpoints, 50 evaluation episodes and 3 training seeds. Which tasks a table
reports stands in the tasks themselves (`TaskSpec.paper_tables`); the numbers are here, by the tasks' short names.
"""

from collections.abc import Iterator

from manifeel_ms3.tasks.registry import full_id, short_name, task_spec, tasks_of_table

from .protocol import Condition

VISION, TACRGB, TACFF = "rgb", "rgb+tacrgb", "rgb+tacff"
MODES = (VISION, TACRGB, TACFF)
"""Observation modes in the order of the paper's columns."""
DP, EQUIDP, FM = "diffusion_policy", "equivariant_diffusion_policy", "flow_matching"

MODALITIES = {
    "PegInsertion": (0.14, 0.21, 0.40),
    "USBInsertion": (0.49, 0.49, 0.56),
    "PowerPlugInsertion": (0.51, 0.51, 0.58),
    "GearAssembly": (0.63, 0.57, 0.66),
    "NutBoltAssembly": (0.80, 0.78, 0.81),
    "BulbInstallation": (0.76, 0.72, 0.81),
    "PegReorientation": (0.29, 0.39, 0.28),
    "ObjectSearch": (0.52, 0.69, 0.52),
    "BallSortingDim": (0.57, 0.72, 0.60),
}
"""Table I: success of Diffusion Policy with ResNet-18 from scratch, by task, in the order of MODES."""
POLICIES = {
    "GearAssembly": {DP: (0.63, 0.57, 0.66), EQUIDP: (0.70, 0.66, 0.74), FM: (0.38, 0.37, 0.39)},
    "BulbInstallation": {DP: (0.76, 0.72, 0.81), EQUIDP: (0.94, 0.94, 0.95), FM: (0.60, 0.63, 0.66)},
    "ObjectSearch": {DP: (0.52, 0.69, 0.52), EQUIDP: (0.44, 0.67, 0.46), FM: (0.16, 0.44, 0.15)},
    "BallSorting": {DP: (0.43, 0.73, 0.50), EQUIDP: (0.21, 0.46, 0.31), FM: (0.41, 0.69, 0.43)},
}
"""Table II: success by task and policy, in the order of MODES."""
ENCODERS = {
    "GearAssembly": dict(resnet18=0.57, unit=0.61, t3=0.57, anytouch=0.28),
    "ObjectSearch": dict(resnet18=0.69, unit=0.58, t3=0.71, anytouch=0.59),
    "BallSorting": dict(resnet18=0.73, unit=0.80, t3=0.68, anytouch=0.74),
}
"""Table III: success of Diffusion Policy with TacRGB, by task and encoder."""
SIMILARITY = {
    "tacrgb": {"ball": (5.67, 0.0579), "bulb": (5.80, 0.0646), "gear": (6.57, 0.0744)},
    "tacff": {"ball": (2.96, 0.0277), "bulb": (3.54, 0.0323), "gear": (2.91, 0.0254)},
}
"""Distances of simulated to real tactile images, FID and KID, by modality and object; features of a ResNet not named."""
RUNTIME = dict(resnet18=8.1, unit=25.8, t3=17.7, anytouch=66.3)
"""Minutes of training for one epoch, by encoder of TacRGB: NVIDIA A30, batch size 8, sorting with 103 demonstrations."""


def paper_condition(
    task: str, mode: str, policy: str = DP, camera: str | None = None, num_demos: int | None = None, encoder: str = "resnet18"
) -> Condition:
    """A condition of the paper.

    Args:
        task: Short name of the task.
        mode: Observation mode, one of MODES.
        policy: Registered name of the policy.
        camera: Camera that the policy observes; the task's policy camera if not given.
        num_demos: Number of training episodes; any number if not given.
        encoder: Encoder of TacRGB images.
    """
    env_id = full_id(task)
    camera = camera or task_spec(env_id).policy_camera
    return Condition(env_id, mode, policy, encoder if mode == TACRGB else "", (camera,), num_demos)


def tasks_in_table(table: str, *categories: str) -> list[str]:
    """Short names of the tasks that a table of the paper reports, in the paper's order.

    Args:
        table: Number of the table: "I", "II" or "III".
        categories: Categories of the tasks; all of them if none is given.
    """
    env_ids = tasks_of_table(table)
    return [short_name(env_id) for env_id in env_ids if not categories or task_spec(env_id).category in categories]


def reported() -> Iterator[tuple[str, Condition, float]]:
    """Every success rate of the paper's tables: number of the table, condition, and rate."""
    for task in tasks_in_table("I"):
        for mode, rate in zip(MODES, MODALITIES[task], strict=True):
            yield "I", paper_condition(task, mode), rate
    for task in tasks_in_table("II"):
        for policy, rates in POLICIES[task].items():
            for mode, rate in zip(MODES, rates, strict=True):
                yield "II", paper_condition(task, mode, policy), rate
    for task in tasks_in_table("III"):
        for encoder, rate in ENCODERS[task].items():
            yield "III", paper_condition(task, TACRGB, encoder=encoder), rate
