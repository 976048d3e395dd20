"""The paper's set-ups, and what it reports of them: mean success over the last 10 checkpoints, 50 starts and 3 seeds."""

from collections.abc import Iterator

from manifeel_ms3.tasks.registry import full_id, task_spec

from .protocol import Setup

VISION, TACRGB, TACFF = "rgb", "rgb+tacrgb", "rgb+tacff"
MODES = (VISION, TACRGB, TACFF)
DP, EQUIDP, FM = "diffusion_policy", "equivariant_diffusion_policy", "flow_matching"

# Table I: Diffusion Policy, ResNet-18 from scratch; by task, in the order of MODES
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
# Table II; by task and policy, in the order of MODES
POLICIES = {
    "GearAssembly": {DP: (0.63, 0.57, 0.66), EQUIDP: (0.70, 0.66, 0.74), FM: (0.38, 0.37, 0.39)},
    "BulbInstallation": {DP: (0.76, 0.72, 0.81), EQUIDP: (0.94, 0.94, 0.95), FM: (0.60, 0.63, 0.66)},
    "ObjectSearch": {DP: (0.52, 0.69, 0.52), EQUIDP: (0.44, 0.67, 0.46), FM: (0.16, 0.44, 0.15)},
    "BallSorting": {DP: (0.43, 0.73, 0.50), EQUIDP: (0.21, 0.46, 0.31), FM: (0.41, 0.69, 0.43)},
}
# Table III: Diffusion Policy with TacRGB; by task and encoder
ENCODERS = {
    "GearAssembly": dict(resnet18=0.57, unit=0.61, t3=0.57, anytouch=0.28),
    "ObjectSearch": dict(resnet18=0.69, unit=0.58, t3=0.71, anytouch=0.59),
    "BallSorting": dict(resnet18=0.73, unit=0.80, t3=0.68, anytouch=0.74),
}
# distance of simulated to real tactile images, by modality and object: FID, KID
SIMILARITY = {
    "tacrgb": {"ball": (5.67, 0.0579), "bulb": (5.80, 0.0646), "gear": (6.57, 0.0744)},
    "tacff": {"ball": (2.96, 0.0277), "bulb": (3.54, 0.0323), "gear": (2.91, 0.0254)},
}
# minutes an epoch, A30, batch 8, sorting with 103 demonstrations, by encoder of TacRGB
RUNTIME = dict(resnet18=8.1, unit=25.8, t3=17.7, anytouch=66.3)


def setup(
    task: str, mode: str, policy: str = DP, camera: str | None = None, num_demos: int | None = None, encoder: str = "resnet18"
) -> Setup:
    """A set-up of the paper, by its task's short name."""
    env_id = full_id(task)
    camera = camera or task_spec(env_id).policy_camera
    return Setup(env_id, mode, policy, encoder if mode == TACRGB else "", (camera,), num_demos)


def reported() -> Iterator[tuple[str, Setup, float]]:
    """Every success rate of the paper's tables: (table, set-up, rate)."""
    for task, rates in MODALITIES.items():
        for mode, rate in zip(MODES, rates, strict=True):
            yield "I", setup(task, mode), rate
    for task, policies in POLICIES.items():
        for policy, rates in policies.items():
            for mode, rate in zip(MODES, rates, strict=True):
                yield "II", setup(task, mode, policy), rate
    for task, encoders in ENCODERS.items():
        for encoder, rate in encoders.items():
            yield "III", setup(task, TACRGB, encoder=encoder), rate
