"""Demonstrators succeed with the actions that policies have, and decide by touch."""

import numpy as np
import pytest

from manifeel_ms3.demonstrations.episode import demonstrate
from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.experts import BallSortingExpert, make_expert
from manifeel_ms3.experts.skills import perceived_position
from manifeel_ms3.sensors.depth.surfaces import RELIEF
from manifeel_ms3.tasks.registry import all_tasks
from tests.tasks_and_marks import PEG

SEARCH = "ManiFeel-ObjectSearch-v1"
LONG_TASKS = ("ManiFeel-NutBoltAssembly-v1", "ManiFeel-BulbInstallation-v1")  # demonstrations of about 400 steps


def gentle_success(env, task: str, seed: int) -> np.ndarray:
    """Actions of a demonstration that succeeds within the limits of actions and force."""
    episode = demonstrate(env, task, seed)
    assert episode.info["success"], f"seed {seed}"
    assert np.abs(episode.arrays["actions"]).max() <= 1.0
    assert episode.info["peak_contact_force"] < 60.0
    return episode.arrays["actions"]


@pytest.mark.parametrize("fit", ["paper", "tight"])
def test_expert_succeeds_gently_within_the_action_limits(make_env, fit):
    env = make_env(obs_mode="none", render_backend="none", fit=fit)
    for seed in range(6):
        actions = gentle_success(env, PEG, seed)
        assert len(actions) < 250  # at most one second attempt


def test_a_goal_that_must_hold_for_longer_makes_demonstrations_that_stay_there(make_env):
    usual, longer = (
        demonstrate(make_env(SEARCH, obs_mode="none", render_backend="none", **given), SEARCH, seed=0)
        for given in (dict(), dict(hold_seconds=2.0))
    )
    first = len(usual.arrays["actions"])
    assert len(longer.arrays["actions"]) == first + 15  # 1.5 s at 10 Hz
    np.testing.assert_array_equal(longer.arrays["actions"][:first], usual.arrays["actions"])
    for episode in (usual, longer):
        assert np.flatnonzero(episode.arrays["success"]).tolist() == [len(episode.arrays["actions"]) - 1]


def test_a_demonstrator_sees_a_part_up_to_a_millimetre_and_a_half_beside_its_place(make_env):
    env = make_env(obs_mode="none", render_backend="none")
    env.reset(seed=0)
    socket, rng = env.unwrapped.socket, np.random.default_rng(0)
    errors = np.array([perceived_position(socket, rng) for _ in range(400)]) - socket.pose.p[0].numpy()
    distance = np.linalg.norm(errors[:, :2], axis=1)
    assert np.abs(errors[:, 2]).max() < 1e-6
    assert 1.4e-3 < distance.max() <= 1.5e-3 + 1e-6
    assert np.median(distance) == pytest.approx(1.5e-3 / np.sqrt(2), rel=0.1)  # even over the disc
    assert np.abs(errors.mean(0)).max() < 1e-4


@pytest.mark.parametrize("task", [PEG, "ManiFeel-NutBoltAssembly-v1", "ManiFeel-BallSorting-v1"])
def test_a_demonstrator_errs_by_its_seed(make_env, task):
    env = make_env(task, obs_mode="none", render_backend="none")

    def first_actions(seed: int) -> np.ndarray:
        env.reset(seed=0)
        done = []
        for _, action in zip(range(8), make_expert(task, env.unwrapped, seed).actions(), strict=False):
            done.append(action)
            env.step(action)
        return np.array(done)

    first = first_actions(1)
    assert np.array_equal(first_actions(1), first)
    assert not np.array_equal(first_actions(2), first)


SHORT_TASKS = sorted(set(all_tasks()) - {PEG, *LONG_TASKS})  # the long ones: below, and in the replays of their samples


@pytest.mark.parametrize("task", SHORT_TASKS + [pytest.param(task, marks=pytest.mark.slow) for task in LONG_TASKS])
def test_every_expert_succeeds_gently(make_env, task):
    env = make_env(task, obs_mode="none", render_backend="none")
    for seed in range(3):
        gentle_success(env, task, seed)


@pytest.mark.slow
@pytest.mark.parametrize("task", ["ManiFeel-USBInsertion-v1", "ManiFeel-PowerPlugInsertion-v1", "ManiFeel-GearAssembly-v1"])
def test_experts_of_close_fits_succeed_gently(make_env, task):
    env = make_env(task, obs_mode="none", render_backend="none", fit="tight")
    for seed in range(3):
        gentle_success(env, task, seed)


def test_demonstrations_of_insertion_hold_pushes_of_the_hand_while_the_plug_is_free(make_env):
    env = make_env(obs_mode="none", render_backend="none")
    pushes = []
    for seed in range(5):
        env.reset(seed=seed)
        expert = make_expert(PEG, env.unwrapped, seed)
        disturb, felt = expert._disturb, []
        expert._disturb = lambda disturb=disturb, felt=felt: felt.append(disturb()) or felt[-1]
        for _, action in zip(range(40), expert.actions(), strict=False):
            env.step(action)
        begun = [
            now
            for before, now in zip([np.zeros(6), *felt], felt, strict=False)
            if now.any() and not np.array_equal(before, now)
        ]
        pushes.append(len(begun))
        assert all(push[2] >= 0 for push in begun)  # none rams the plug into the rim
    assert 1 <= np.mean(pushes) <= 4


@pytest.mark.parametrize(
    ("task", "variant", "action_dim"),
    [
        ("ManiFeel-BallSorting-v1", dict(goal="bowls", max_episode_steps=400), 7),
        ("ManiFeel-BulbInstallation-v1", dict(start="holder"), 5),
        ("ManiFeel-GearAssembly-v1", dict(randomization=dict(base_yaw=0.3)), 6),
    ],
)
def test_variants_of_the_real_robot_are_demonstrated(make_env, task, variant, action_dim):
    env = make_env(task, obs_mode="none", render_backend="none", **variant)
    gentle_success(env, task, 0)
    assert env.action_space.shape == (action_dim,)


@pytest.mark.parametrize(("control_mode", "action_dim"), [("pd_ee_delta_pose", 7), ("pd_ee_delta_yaw", 5)])
def test_insertion_is_demonstrated_with_controllers_that_take_other_actions(make_env, control_mode, action_dim):
    """Those with a gripper keep the grip; one that only turns about the vertical leaves the peg's lean to the socket."""
    env = make_env(obs_mode="none", render_backend="none", control_mode=control_mode)
    gentle_success(env, PEG, 0)
    assert env.action_space.shape == (action_dim,)


@pytest.mark.parametrize(
    ("task", "control_mode", "said"),
    [
        (
            PEG,
            "pd_ee_pose",
            r"of PegInsertionEnv move the tool by steps; choose from \['pd_ee_delta_pose', 'pd_ee_delta_pose_fixed",
        ),
        (PEG, "pd_joint_delta_pos", "move the tool by steps"),
        (
            "ManiFeel-ObjectSearch-v1",
            "pd_ee_delta_pose_fixed_gripper",
            r"by steps, and the fingers; .* \['pd_ee_delta_pose', 'pd_e",
        ),
    ],
)
def test_controllers_that_no_demonstrator_commands_are_refused(make_env, task, control_mode, said):
    env = make_env(task, obs_mode="none", render_backend="none", control_mode=control_mode)
    env.reset(seed=0)
    with pytest.raises(InvalidArgumentError, match=f"control_mode='{control_mode}': .*{said}"):
        make_expert(task, env.unwrapped, 0)


def test_reorientation_turns_the_peg_in_the_hand(make_env):
    """The hand goes upright and stays so, but for the lean that feels for the hole; the peg turns in it."""
    task = "ManiFeel-PegReorientation-v1"
    env = make_env(task, obs_mode="none", render_backend="none", randomization=dict(start_xy=0.02, start_z=0.0))
    env.reset(seed=5)
    tilts, angles = [], [float(env.unwrapped.measure()["in_hand"])]
    for action in make_expert(task, env.unwrapped, 5).actions():
        *_, terminated, truncated, info = env.step(action)
        tilts.append(float(info["hand_tilt"]))
        angles.append(float(info["in_hand"]))
        if terminated or truncated:
            break
    assert info["success"].all()
    assert np.rad2deg(angles[0]) > 15
    assert np.rad2deg(angles[-1]) < 3
    assert np.rad2deg(max(tilts)) < 12


def test_screwing_regrasps_and_stops_when_it_is_tight(make_env):
    """The bulb is let go of, and turned until the pads feel the torque, not for a set number of turns."""
    task = "ManiFeel-BulbInstallation-v1"
    env = make_env(task, obs_mode="none", render_backend="none")
    env.reset(seed=0)
    openings, torques = [], []
    for action in make_expert(task, env.unwrapped, 0).actions():
        *_, terminated, truncated, info = env.step(action)
        openings.append(action[-1])
        torques.append(float(info["torque"]))
        if terminated or truncated:
            break
    assert info["success"].all()
    assert max(openings) > 0.5  # let go
    assert np.median(np.abs(torques[:-60])) < 0.02
    assert min(torques[-5:]) > 0.1


def test_search_goes_to_the_other_place_when_it_feels_nothing(make_env):
    env = make_env("ManiFeel-ObjectSearch-v1", obs_mode="none", render_backend="none")
    visited = []
    for seed in range(6):
        env.reset(seed=seed)
        base, places = env.unwrapped, []
        expert = make_expert("ManiFeel-ObjectSearch-v1", base, seed)
        for action in expert.actions():
            *_, terminated, truncated, _ = env.step(action)
            x, z = float(base.agent.tcp.pose.p[0, 0]) - 0.5, float(base.agent.tcp.pose.p[0, 2])
            if z < 0.05 and (not places or places[-1] != int(x > 0)):
                places.append(int(x > 0))
            if terminated or truncated:
                break
        assert places == [0, 1][: 1 + int(base.place)]
        visited.append(len(places))
    assert set(visited) == {1, 2}


def test_sorting_decides_by_the_dimples_it_feels(make_env):
    """With the dimples taken off the golf ball, the expert finds no ball to keep."""
    env = make_env("ManiFeel-BallSorting-v1", obs_mode="none", render_backend="none")
    env.reset(seed=0)
    delattr(env.unwrapped.golf, RELIEF)
    expert = make_expert("ManiFeel-BallSorting-v1", env.unwrapped, 0)
    felt = []
    roughness = expert.roughness
    expert.roughness = lambda: felt.append(roughness()) or felt[-1]
    for _, action in zip(range(250), expert.actions(), strict=False):
        env.step(action)
    assert len(felt) == 3
    assert max(felt) < BallSortingExpert.config.rough


def test_sorting_leaves_a_ball_by_another_way_than_it_comes(make_env):
    """So that a policy without memory can tell the two ways apart."""
    env = make_env("ManiFeel-BallSorting-v1", obs_mode="none", render_backend="none")
    sides = {"down": [], "up": []}
    for seed in range(6):
        env.reset(seed=seed)
        base, expert = env.unwrapped, make_expert("ManiFeel-BallSorting-v1", env.unwrapped, seed)
        if expert.first != int(base.swapped):  # else the first ball is kept
            sign, before = 2 * expert.first - 1, None
            for _, action in zip(range(60), expert.actions(), strict=False):
                env.step(action)
                x, y, z = (base.agent.tcp.pose.p - base.stand.pose.p)[0].tolist()
                if before and y * sign > 0.04 and 0.045 < z < 0.075:
                    sides["down" if z < before else "up"].append(x * sign)
                before = z
    assert sides["down"]
    assert max(sides["down"]) < 0
    assert sides["up"]
    assert min(sides["up"]) > 0


def test_unknown_task_names_those_that_have_an_expert(make_env):
    env = make_env(obs_mode="none", render_backend="none")
    with pytest.raises(ValueError, match=PEG):
        make_expert("ManiFeel-Juggling-v1", env.unwrapped, 0)
