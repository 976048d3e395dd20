"""The insertion tasks: success is contact physics alone; near misses do not count."""

import numpy as np
import pytest
import sapien
import torch
from mani_skill.utils.structs import Pose
from scipy.spatial.transform import Rotation

from manifeel_ms3.geometry import block_with_holes, gear_fit, peg_fit, power_fit, reorientation_fit, usb_fit
from manifeel_ms3.geometry.part import Hulls
from manifeel_ms3.geometry.plugs import PEG_HOLES
from manifeel_ms3.tasks.exploration.peg_reorientation import PegReorientationEnv
from manifeel_ms3.tasks.insertion.base import InsertionEnv
from tests.conftest import PEG

FITS = {
    PEG: peg_fit("tight"),
    "ManiFeel-USBInsertion-v1": usb_fit(),
    "ManiFeel-PowerPlugInsertion-v1": power_fit(),
    "ManiFeel-PegReorientation-v1": reorientation_fit(),
    "ManiFeel-GearAssembly-v1": gear_fit(),
}


@pytest.fixture(scope="module", params=FITS)
def env(request, make_env):
    # the goal of PegReorientation asks for an upright hand
    upright = dict(randomization=dict(start_rotation=0.0)) if "Reorientation" in request.param else {}
    return make_env(request.param, obs_mode="state_dict", render_backend="none", reward_mode="dense", **upright)


def measures_with_plug_at(env, offset, tilt_degrees=0.0) -> tuple[dict, bool]:
    """Measures with the plug's foremost face at `offset` from the floor's middle, tilted about y."""
    base = env.unwrapped
    turn = Rotation.from_euler("y", tilt_degrees, degrees=True) * Rotation.from_euler("x", np.pi)
    socket = base.socket.pose.raw_pose[0, :3].double().numpy() + np.array([0, 0, base.fit.floor])
    centre = socket + np.array(offset) - turn.apply([0, 0, base.fit.reach])
    quaternion = turn.as_quat()[[3, 0, 1, 2]]
    base.plug.set_pose(Pose.create_from_pq(torch.tensor(centre[None]).float(), torch.tensor(quaternion[None]).float()))
    measures = base.measure()
    return measures, bool(base.goal_reached(measures))


def test_seated_plug_is_the_goal(env):
    env.reset(seed=0)
    measures, reached = measures_with_plug_at(env, (0, 0, 0.0))
    assert reached
    assert float(measures["gap"]) == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(
    ("miss", "offset", "depth", "tilt"),
    [
        ("on the rim", (0, 0), 1.0, 0),
        ("half inserted", (0, 0), 0.5, 0),
        ("four fifths in", (0, 0), 0.2, 0),
        ("tilted", (0, 0), 0.0, 3.5),
        ("beside the socket", (0.04, 0), 0.0, 0),
        ("lying", (0, 0), 0.0, 90),
        ("upside down", (0, 0), 0.0, 180),
    ],
)
def test_near_misses_are_not_the_goal(env, miss, offset, depth, tilt):
    env.reset(seed=0)
    _, reached = measures_with_plug_at(env, (*offset, depth * env.unwrapped.fit.depth), tilt)
    assert not reached, miss


def test_goal_must_hold_half_a_second(env):
    env.reset(seed=0)
    base = env.unwrapped
    base._steps_at_goal[:] = 4
    assert not base.evaluate()["success"].any()
    base._steps_at_goal[:] = 5
    assert base.evaluate()["success"].all()
    env.step(np.zeros(6))  # the plug is in the air
    assert base._steps_at_goal.item() == 0


def test_randomisation_covers_its_ranges_and_no_more(env):
    sockets, starts, pitches = [], [], []
    base, ranges = env.unwrapped, env.unwrapped.randomization
    for seed in range(30):
        env.reset(seed=seed)
        sockets.append(base.socket.pose.p[0, :2].numpy() - [0.5, 0.0])
        starts.append(base.agent.tcp_pose_at_base.p[0].numpy() - [0.5, 0.0, 0.15 + base.lift])
        held = (base.agent.tcp.pose.inv() * base.plug.pose).raw_pose[0].numpy()
        pitches.append(Rotation.from_quat(held[[4, 5, 6, 3]]).as_rotvec()[1])
    for values, limit in (
        (sockets, ranges.socket_xy),
        (np.array(starts)[:, :2], ranges.start_xy),
        (np.array(starts)[:, 2], ranges.start_z),
        (pitches, ranges.in_hand_pitch),
    ):
        spread = np.abs(values)
        assert spread.max() <= limit + 0.02 * limit + 4e-3
        assert spread.max() >= 0.7 * limit


def test_default_ranges_are_the_papers():
    insertion, reorientation = InsertionEnv.Randomization(), PegReorientationEnv.Randomization()
    assert (insertion.socket_xy, insertion.start_xy, insertion.start_z, insertion.start_rotation) == (0.05, 0.10, 0.05, 0.1)
    assert np.rad2deg([insertion.in_hand_pitch, reorientation.in_hand_pitch]) == pytest.approx([10, 30])


def test_randomization_argument_narrows(make_env):
    narrow = make_env(obs_mode="none", render_backend="none", randomization=dict(socket_xy=0.0, start_xy=0.0, start_z=0.0))
    for seed in range(3):
        narrow.reset(seed=seed)
        assert narrow.unwrapped.socket.pose.p[0].tolist() == pytest.approx([0.5, 0, 0], abs=1e-6)
        assert narrow.unwrapped.agent.tcp_pose_at_base.p[0].tolist() == pytest.approx([0.5, 0, 0.15], abs=1e-3)


def test_plug_fits_its_socket_and_a_shifted_one_does_not(env):
    """Pieces of the seated plug and of the socket do not overlap; shifted sideways by the clearance and a bit, they do."""
    fit = env.unwrapped.fit
    if any(isinstance(piece, Hulls) for piece in fit.plug.pieces):
        pytest.skip("gears: tests/geometry/test_gears.py")
    flip = sapien.Pose([0, 0, fit.floor + fit.reach], [0, 1, 0, 0])

    def overlap(shift: np.ndarray) -> bool:
        for piece in fit.plug.pieces:
            size = getattr(piece, "size", None) or (2 * piece.radius, 2 * piece.radius, piece.length)
            centre = (flip * sapien.Pose(piece.centre)).p + shift
            for wall in fit.socket.pieces:
                gap = np.abs(centre - wall.centre) - (np.array(size) + wall.size) / 2
                if (gap < -2e-6).all():
                    return True
        return False

    assert not overlap(np.zeros(3))
    loosest = 2.1e-4
    for axis in (0, 1):
        shift = np.zeros(3)
        shift[axis] = loosest
        assert overlap(shift)


def test_gear_needs_its_neighbours_in_place(make_env):
    env = make_env("ManiFeel-GearAssembly-v1", obs_mode="none", render_backend="none")
    env.reset(seed=0)
    base = env.unwrapped
    assert measures_with_plug_at(env, (0, 0, 0))[1]
    pose = base.neighbours["small"].pose.raw_pose.clone()
    pose[:, 2] += 0.002
    base.neighbours["small"].set_pose(Pose.create(pose))
    assert not base.goal_reached(base.measure())


@pytest.mark.parametrize("fit", PEG_HOLES)
def test_hole_is_as_large_as_it_says(fit):
    """Area of the slab = area of its boxes + area of the hole."""
    boxes = peg_fit(fit).socket.pieces
    hole = PEG_HOLES[fit]
    covered = sum(box.size[0] * box.size[1] for box in boxes)
    assert covered + hole[0] * hole[1] == pytest.approx(0.025**2)
    for box in boxes:
        assert (
            abs(box.centre[0]) + 1e-9 >= (hole[0] + box.size[0]) / 2 or abs(box.centre[1]) + 1e-9 >= (hole[1] + box.size[1]) / 2
        )


def test_impossible_holes_are_refused():
    with pytest.raises(ValueError, match="overlaps"):
        block_with_holes((0.02, 0.02), 0.01, [((0.01, 0.01), (0.006, 0.0))])
    with pytest.raises(ValueError, match="overlaps"):
        block_with_holes((0.05, 0.02), 0.01, [((0.01, 0.01), (-0.004, 0.0)), ((0.01, 0.01), (0.004, 0.0))])


def test_dropped_plug_fails(make_env):
    env = make_env(obs_mode="none", render_backend="none", control_mode="pd_ee_delta_pose")
    env.reset(seed=0)
    for _ in range(10):
        *_, terminated, _, info = env.step(np.r_[np.zeros(6), 1.0])
    assert info["fail"].all()
    assert terminated.all()
    assert not info["success"].any()


def test_dense_reward_rises_towards_the_goal(env):
    env.reset(seed=0)
    rewards, depth = [], env.unwrapped.fit.depth
    for offset, tilt in (
        ((0.05, 0.05, 0.1), 10),
        ((0.005, 0, 2 * depth), 5),
        ((0, 0, depth), 2),
        ((0, 0, depth / 2), 0),
        ((0, 0, 0), 0),
    ):
        measures, _ = measures_with_plug_at(env, offset, tilt)
        info = measures | dict(success=torch.tensor([False]))
        rewards.append(float(env.unwrapped.compute_dense_reward(None, None, info)))
    assert rewards == sorted(rewards)
    assert 0 <= rewards[0] < rewards[-1] <= 3.0
