"""The questions that the information audit asks of recorded demonstrations, attached to the tasks that they belong to.

A question about an episode has an answer that the simulator's state gives: which ball is held, on which side the battery lies,
at what angle the peg lies in the hand. A task of another package registers a question of its own in the same way:

    @register_probe("MyTask-v1", question="lid closed or open")
    def lid(episode):
        yield 5, float(episode["env_states/actors/lid"][5, 2] < 0.1)
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from manifeel_ms3.geometry import bulb_and_holder, nut_and_bolt
from manifeel_ms3.tasks.exploration.object_search import CONTAINER_XY
from manifeel_ms3.tasks.obs_modes import POSE
from manifeel_ms3.tasks.registry import task_spec

EpisodeGroup = Any
"""Group of one episode in a trajectory file, as h5py reads it."""
Samples = Iterator[tuple[int, float]]
"""Pairs of an observation's index and the true answer at that moment."""
Sampler = Callable[[EpisodeGroup], Samples]

IN_CONTACT = 1.5
"""Force in N, beyond its weight, above which a held part touches the world."""
IN_FREE_MOTION = 0.5
"""Force in N, beyond its weight, below which a held part moves freely; forces between the two are ambiguous and not asked
about."""
CLOSING = 0.5
"""Action of the gripper below which the fingers close; 1 opens, and demonstrators command -0.4 (balls) and -1 to close."""
STILL = 0.05
"""Largest component of an action of the arm that keeps the hand where it is."""
EARLY = (1, 4, 7)
"""Observations at the beginning of an episode, 0.3 s apart, before the demonstrator has reached anything."""
BETWEEN_FINGERS = 0.04
"""Horizontal distance in m between battery and tool below which the battery is held: half of the widest opening of the
Panda's fingers."""
CONTACT_STRIDE, BULB_STRIDE = 4, 3
"""Control steps from one sample to the next, since neighbouring ones are almost the same; a bulb is tightened in few steps."""
SPRING_PRESSED = 2e-4
"""Travel in m beyond the first touch of a seated bulb from which it is tight: the contact's spring is pressed in."""
NEARLY_SEATED = 0.5
"""Largest distance from the seat at which a bulb is asked about, as a share of the thread's pitch; further out the answer is
plain."""


@dataclass(frozen=True)
class Probe:
    """A question about single moments of a recorded episode."""

    question: str
    """The question, in a few words."""
    samples: Sampler
    """Function that yields the moments to ask about and the true answers, from an episode."""
    unit: str = ""
    """Unit of a number to estimate; empty where the answer is one of two classes, 0.0 or 1.0."""


def register_probe(*env_ids: str, question: str, unit: str = "") -> Callable[[Sampler], Sampler]:
    """Decorator that attaches a question to tasks that are registered already.

    Args:
        env_ids: Ids of the tasks.
        question: The question, in a few words.
        unit: Unit of the answer if it is a number; empty if it is one of two classes.

    Raises:
        UnknownNameError: A task is not registered.
    """

    def attach(samples: Sampler) -> Sampler:
        for env_id in env_ids:
            task_spec(env_id).probes.append(Probe(question, samples, unit))
        return samples

    return attach


def _position(episode: EpisodeGroup, actor: str) -> np.ndarray:
    return episode[f"env_states/actors/{actor}"][:, :3]


def _end_of_first_closing(episode: EpisodeGroup) -> list[int]:
    """Last observation before the hand, whose fingers have closed, lifts or lets go: nothing shows yet what it felt."""
    arm, gripper = np.abs(episode["actions"][:, :-1]).max(1), episode["actions"][:, -1]
    closing = (gripper < CLOSING) & (arm < STILL)
    return [int(t) + 1 for t in np.flatnonzero(closing[:-1] & ~closing[1:])[:1]]


@register_probe("ManiFeel-BallSorting-v1", "ManiFeel-BallSortingDim-v1", question="ball in the hand: golf or table tennis")
def _golf_ball_held(episode: EpisodeGroup) -> Samples:
    tool = episode[f"obs/{POSE}"][:, :3]
    for t in _end_of_first_closing(episode):  # the first grasp takes the wrong ball half of the time
        distance = [np.linalg.norm(_position(episode, f"{ball}_ball")[t] - tool[t]) for ball in ("golf", "tennis")]
        yield t, float(distance[0] < distance[1])


@register_probe("ManiFeel-ObjectSearch-v1", question="battery's place, before contact")
def _battery_in_far_half(episode: EpisodeGroup) -> Samples:
    far = float(_position(episode, "battery")[0, 0] > CONTAINER_XY[0])
    for t in EARLY:
        yield t, far


@register_probe("ManiFeel-ObjectSearch-v1", question="battery between the fingers or not, once closed")
def _battery_held(episode: EpisodeGroup) -> Samples:
    tool = episode[f"obs/{POSE}"][:, :3]
    for t in _end_of_first_closing(episode):
        distance = np.linalg.norm((_position(episode, "battery")[t] - tool[t])[:2])
        yield t, float(distance < BETWEEN_FINGERS)


@register_probe("ManiFeel-PegInsertion-v1", "ManiFeel-PegReorientation-v1", question="peg's pitch in the hand", unit="degrees")
def _pitch_in_hand(episode: EpisodeGroup) -> Samples:
    (name,) = [name for name in episode["env_states/actors"] if name.endswith("peg")]
    plug = episode[f"env_states/actors/{name}"][:, 3:7]
    tool = episode[f"obs/{POSE}"][:, 3:7]
    for t in EARLY:
        held = Rotation.from_quat(tool[t], scalar_first=True).inv() * Rotation.from_quat(plug[t], scalar_first=True)
        yield t, float(np.rad2deg(held.as_rotvec()[1]))


@register_probe("ManiFeel-PegInsertion-v1", "ManiFeel-PegReorientation-v1", question="peg touches or not")
def _in_contact(episode: EpisodeGroup) -> Samples:
    force = _force_beyond_weight(episode)
    for t in range(0, len(force), CONTACT_STRIDE):
        if force[t] > IN_CONTACT or force[t] < IN_FREE_MOTION:
            yield t + 1, float(force[t] > IN_CONTACT)  # the force of step t belongs to the observation after it


def _force_beyond_weight(episode: EpisodeGroup) -> np.ndarray:
    """Contact force (T,), in N, beyond the smallest of the episode, with which the fingers carry the part's weight."""
    force = episode["contact_force"][()]
    return force - force.min()


def _touching(episode: EpisodeGroup, stride: int) -> Iterator[int]:
    """Observations at which a held part touches the world."""
    force = _force_beyond_weight(episode)
    return (t + 1 for t in range(0, len(force), stride) if force[t] > IN_CONTACT)


def _descent(episode: EpisodeGroup, held: str, fixed: str, engaged: float) -> np.ndarray:
    """Distance in m that a screwed part has gone down since its thread could engage."""
    return engaged - (_position(episode, held)[:, 2] - _position(episode, fixed)[:, 2])


@register_probe("ManiFeel-NutBoltAssembly-v1", question="thread engaged or resting on it")
def _thread_engaged(episode: EpisodeGroup) -> Samples:
    screw = nut_and_bolt()
    descent = _descent(episode, "nut", "bolt", screw.engaged)
    for t in _touching(episode, CONTACT_STRIDE):
        if abs(descent[t]) < screw.pitch:
            yield t, float(descent[t] > 0)


@register_probe("ManiFeel-BulbInstallation-v1", question="bulb tight or not yet")
def _bulb_tight(episode: EpisodeGroup) -> Samples:
    screw = bulb_and_holder()
    gap = screw.engaged - screw.seated - _descent(episode, "bulb", "holder", screw.engaged)
    for t in _touching(episode, BULB_STRIDE):
        if gap[t] < NEARLY_SEATED * screw.pitch:
            yield t, float(gap[t] < -SPRING_PRESSED)
