"""The paper's claims as comparisons: which condition is said to succeed more often than which other one."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain

from .condition import Condition
from .paper import (
    DIM,
    DP,
    EQUIDP,
    FM,
    MODES,
    REAL_RATES,
    SATURATION_DEMOS,
    SCRATCH,
    TACFF,
    TACRGB,
    TACSL,
    TWIN_RATES,
    VISION,
    paper_condition,
    tasks_in_table,
    twin_condition,
)

NO_ENCODER_IS_BEST = "6. No tactile encoder is best on all tasks"
"""The claim that is no comparison of two conditions; `manifeel_ms3.analysis.encoder_ranking` answers it."""
FEWER_DEMOS, MORE_DEMOS = 40, 100
"""Numbers of training episodes on either side of the one where success is said to saturate."""


@dataclass(frozen=True)
class Comparison:
    """A claim about two conditions of one task; their settings are left open, but must be the same."""

    claim: str
    """Number of the claim, and its text."""
    first: Condition
    second: Condition
    gain: bool = True
    """Whether the claim is that the first condition succeeds more often; otherwise, that it does not."""


def comparisons() -> Iterator[Comparison]:
    """All comparisons of the paper's claims. Both sides have the paper's number of demonstrations."""
    groups = (_touch_claims, _tacrgb_claims, _policy_claims, _encoder_claims, _demo_claims, _camera_claims, _real_claims)
    return chain.from_iterable(group() for group in groups)


def _touch_claims() -> Iterator[Comparison]:
    for task in tasks_in_table("I", "insertion", "screwing"):
        touched, seen = paper_condition(task, TACFF), paper_condition(task, VISION)
        in_tacsl_units = paper_condition(task, TACFF, variant=TACSL)
        yield Comparison("1. TacFF is above vision in insertion and screwing", touched, seen)
        yield Comparison("1. TacFF in TacSL's units, as in the paper, is above vision there", in_tacsl_units, seen)
    for task in tasks_in_table("I", "exploration"):
        touched, pictured, seen = (paper_condition(task, mode) for mode in (TACFF, TACRGB, VISION))
        yield Comparison("2. TacRGB is above vision in exploration", pictured, seen)
        yield Comparison("2. TacRGB is above TacFF in exploration", pictured, touched)
        yield Comparison("2. TacFF is no gain over vision in exploration (read off Table I)", touched, seen, gain=False)


def _tacrgb_claims() -> Iterator[Comparison]:
    """The claims about TacRGB in tasks that its images do not help."""
    for task in tasks_in_table("I", "insertion", "screwing"):
        with_picture, without = paper_condition(task, TACRGB), paper_condition(task, VISION)
        if task == "PegInsertion":
            yield Comparison("3. TacRGB is above vision on the peg (read off Table I)", with_picture, without)
        else:
            claim = "3. TacRGB is no gain over vision in insertion and screwing, except for the peg (read off Table I)"
            yield Comparison(claim, with_picture, without, gain=False)
    for policy in (DP, EQUIDP, FM):
        with_picture, without = (paper_condition("GearAssembly", mode, policy) for mode in (TACRGB, VISION))
        yield Comparison("3. TacRGB takes success away on gear, with every policy", without, with_picture)


def _policy_claims() -> Iterator[Comparison]:
    for task in tasks_in_table("II"):
        exploration = task in tasks_in_table("II", "exploration")
        for mode in MODES:
            dp, equidp, fm = (paper_condition(task, mode, policy) for policy in (DP, EQUIDP, FM))
            yield Comparison("4. Flow Matching is below Diffusion Policy", dp, fm)
            if exploration:
                yield Comparison("5. Equivariant Diffusion Policy is below on search and sorting", dp, equidp)
            else:
                yield Comparison("5. Equivariant Diffusion Policy is above on gear and bulb", equidp, dp)


def _encoder_claims() -> Iterator[Comparison]:
    for task in tasks_in_table("III"):
        scratch, unit, t3 = (paper_condition(task, TACRGB, encoder=name) for name in (SCRATCH, "unit", "t3"))
        for encoder in (unit, t3):  # the text says so; in the paper's own Table III it holds in three cases of six
            yield Comparison("6. UniT and T3 are above ResNet-18 from scratch", encoder, scratch)
    scratch, anytouch = (paper_condition("GearAssembly", TACRGB, encoder=name) for name in (SCRATCH, "anytouch"))
    yield Comparison("6. AnyTouch is below ResNet-18 from scratch on gear", scratch, anytouch)


def _demo_claims() -> Iterator[Comparison]:
    for mode in MODES:
        counts = (FEWER_DEMOS, SATURATION_DEMOS, MORE_DEMOS)
        fewer, saturated, more = (paper_condition("GearAssembly", mode, num_demos=count) for count in counts)
        yield Comparison(f"7. Success grows up to about {SATURATION_DEMOS} demonstrations", saturated, fewer)
        yield Comparison(f"7. Success saturates near {SATURATION_DEMOS} demonstrations", more, saturated, gain=False)


def _camera_claims() -> Iterator[Comparison]:
    """The front camera is occluded, the wrist camera sees the inside in dim light."""
    views = {"wrist": DIM, "front": None}
    seen = {
        (mode, camera): paper_condition("ObjectSearch", mode, camera=camera, variant=variant)
        for mode in (VISION, TACRGB)
        for camera, variant in views.items()
    }
    for mode in (VISION, TACRGB):
        claim = "8. The wrist camera in dim light is above the occluded front camera in object search"
        yield Comparison(claim, seen[mode, "wrist"], seen[mode, "front"])
    for camera in views:
        yield Comparison("8. TacRGB helps from both viewpoints", seen[TACRGB, camera], seen[VISION, camera])


def _real_claims() -> Iterator[Comparison]:
    """The gains that the paper saw on its real robot, in the simulated twin of that robot's set-ups."""
    gear, bulb = ({mode: twin_condition(task, mode) for mode in MODES} for task in ("GearAssembly", "BulbInstallation"))
    claim = f"9. As on the real robot, TacFF is above vision on gear ({_real_rates('GearAssembly')})"
    yield Comparison(claim, gear[TACFF], gear[VISION])
    for other in (VISION, TACRGB):
        claim = f"9. As on the real robot, TacFF is best on the bulb ({_real_rates('BulbInstallation')})"
        yield Comparison(claim, bulb[TACFF], bulb[other])
    for task in ("BallSorting", "BallSortingDim"):
        with_picture, without = (twin_condition(task, mode) for mode in (TACRGB, VISION))
        claim = f"9. As on the real robot, TacRGB is above vision in sorting ({_real_rates(task)})"
        yield Comparison(claim, with_picture, without)


def _real_rates(task: str) -> str:
    """The paper's rates on the real robot and in its simulated twin, in words."""
    places = {"there": REAL_RATES.get(task), "in the paper's simulation": TWIN_RATES.get(task)}
    texts = [
        f"{' to '.join(f'{100 * rate:.0f}' for rate in rates.values())} % {where}" for where, rates in places.items() if rates
    ]
    return ", ".join(texts) or "no numbers given"
