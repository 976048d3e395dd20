"""ObjectSearch and BallSorting: near misses do not count, and only touch can tell what cameras cannot see."""

import numpy as np
import pytest
import torch
from mani_skill.utils.structs import Pose

from manifeel_ms3.experts.skills import Skills
from manifeel_ms3.geometry.balls import BALL_RADIUS, DIMPLE_DEPTH, SEAT_HEIGHT, golf_ball_mesh
from manifeel_ms3.geometry.containers import BATTERY_SIZE, BOWL_FLOOR, BOWL_HEIGHT, CONTAINER_OUTER, CONTAINER_WALL
from manifeel_ms3.tasks.exploration.ball_sorting import BOWLS
from manifeel_ms3.tasks.placement import POINTING_DOWN, WORKSPACE_XY
from manifeel_ms3.tasks.registry import task_spec
from tests.tasks_and_marks import needs_renderer

SORTING, SEARCH = "ManiFeel-BallSorting-v1", "ManiFeel-ObjectSearch-v1"


def lift(actor, height: float) -> None:
    pose = actor.pose.raw_pose.clone()
    pose[:, 2] += height
    actor.set_pose(Pose.create(pose))


@pytest.mark.parametrize(
    ("golf", "tennis", "goal"), [(0.11, 0.0, True), (0.09, 0.0, False), (0.0, 0.11, False), (0.11, 0.011, False)]
)
def test_only_the_golf_ball_lifted_alone_counts(make_env, golf, tennis, goal):
    env = make_env(SORTING, obs_mode="none", render_backend="none")
    env.reset(seed=0)
    base = env.unwrapped
    lift(base.golf, golf)
    lift(base.tennis, tennis)
    assert bool(base.goal_reached(base.measure())) is goal
    assert bool(base.paper_goal_reached(base.measure())) is (golf > 0.1)  # the public code does not look at the other ball


def test_a_table_tennis_ball_that_was_pushed_aside_has_left_its_seat(make_env):
    env = make_env(SORTING, obs_mode="none", render_backend="none")
    env.reset(seed=0)
    base = env.unwrapped
    lift(base.golf, 0.11)
    seated = base.tennis.pose.p.clone()
    for aside, goal in ((0.009, True), (0.011, False)):
        for direction in ([aside, 0.0, 0.0], [0.0, -aside, 0.0]):
            base.tennis.set_pose(Pose.create_from_pq(seated + torch.tensor([direction])))
            assert bool(base.goal_reached(base.measure())) is goal


def test_a_ball_fails_when_it_lies_on_the_table(make_env):
    env = make_env(SORTING, obs_mode="none", render_backend="none")
    env.reset(seed=0)
    base = env.unwrapped
    for ball in (base.golf, base.tennis):
        seated = ball.pose
        for over_table, fails in ((0.0, True), (0.0045, True), (0.0055, False)):
            ball.set_pose(Pose.create_from_pq(torch.tensor([[0.5, 0.3, BALL_RADIUS + over_table]])))
            assert bool(base.failed(base.measure())) is fails
        ball.set_pose(seated)
    assert not base.failed(base.measure())


def test_a_ball_is_grasped_by_both_pads(make_env):
    env = make_env(SORTING, obs_mode="none", render_backend="none")
    env.reset(seed=0)
    base = env.unwrapped
    at_pad = base.agent.gels["right"].pose * Pose.create_from_pq(torch.tensor([[0.0, 0.0, BALL_RADIUS - 4e-4]]))
    base.golf.set_pose(at_pad)
    base.scene.step()
    forces = {side: base.scene.get_pairwise_contact_forces(gel, base.golf).norm() for side, gel in base.agent.gels.items()}
    assert forces["right"] > 1.0  # N
    assert forces["left"] == 0
    assert not base.agent.is_grasping(base.golf)


def test_balls_swap_and_rest_in_their_seats(make_env):
    env = make_env(SORTING, obs_mode="none", render_backend="none")
    sides = []
    for seed in range(20):
        env.reset(seed=seed)
        base = env.unwrapped
        sides.append(bool(base.swapped))
        assert abs(float(base.golf.pose.p[0, 2]) - SEAT_HEIGHT) < 2e-4
        assert float(base.measure()["tennis_away"]) < 2e-4
    assert 5 <= sum(sides) <= 15


@pytest.mark.parametrize(("golf", "tennis", "goal"), [(0.0, 0.0, False), (0.11, 0.0, True), (0.0, 0.11, False)])
def test_a_state_with_the_balls_the_other_way_round_has_its_own_seats(make_env, golf, tennis, goal):
    one, other = (make_env(SORTING, obs_mode="none", render_backend="none").unwrapped for _ in range(2))
    one.reset(seed=0)
    lift(one.golf, golf)
    lift(one.tennis, tennis)
    other.reset(seed=2)
    assert bool(one.swapped) is not bool(other.swapped)
    other.set_state_dict(one.get_state_dict())
    assert {name: value.item() for name, value in other.measure().items()} == pytest.approx(
        {name: value.item() for name, value in one.measure().items()}, abs=1e-6
    )
    assert bool(other.goal_reached(other.measure())) is goal
    seats = other.swapped.clone()
    lift(other.golf, 0.2)
    lift(other.tennis, 0.2)
    away = other.get_state_dict()
    other.reset(seed=2, options=dict(reset_to_env_states=dict(env_states=one.get_state_dict())))
    other.set_state_dict(away)  # neither ball shows the seats, which stay those of the last state
    assert torch.equal(other.swapped, seats)


def test_golf_ball_has_its_dimples():
    radius = np.linalg.norm(golf_ball_mesh().vertices, axis=1)
    assert radius.max() == pytest.approx(BALL_RADIUS, abs=1e-6)
    assert radius.min() == pytest.approx(BALL_RADIUS - DIMPLE_DEPTH, abs=5e-6)
    assert 0.5 < (radius < BALL_RADIUS - 1e-5).mean() < 0.7  # share of the surface


@needs_renderer
def test_cameras_cannot_tell_the_balls_apart(make_env):
    env = make_env(SORTING, obs_mode="rgb", cameras=("front", "wrist"))
    env.reset(seed=3)
    base = env.unwrapped
    before = {name: data["rgb"].clone() for name, data in base.get_obs()["sensor_data"].items()}
    golf, tennis = base.golf.pose.raw_pose.clone(), base.tennis.pose.raw_pose.clone()

    def difference(name: str) -> float:
        return (base.get_obs()["sensor_data"][name]["rgb"].int() - before[name].int()).abs().max()

    base.golf.set_pose(Pose.create(tennis))
    base.tennis.set_pose(Pose.create(golf))
    assert all(difference(name) <= 2 for name in before)  # a sphere's facets turn with it
    base.tennis.set_pose(Pose.create(golf + golf.new_tensor([[0.0, 0.0, 0.02, 0.0, 0.0, 0.0, 0.0]])))
    assert all(difference(name) > 50 for name in before)  # the cameras do see the ball


@pytest.mark.parametrize(("height", "goal"), [(0.11, True), (0.09, False)])
def test_battery_must_be_lifted(make_env, height, goal):
    env = make_env(SEARCH, obs_mode="none", render_backend="none")
    env.reset(seed=0)
    base = env.unwrapped
    lift(base.battery, height)
    assert bool(base.goal_reached(base.measure())) is goal


def test_a_battery_in_a_corner_of_the_container_has_not_failed(make_env):
    env = make_env(SEARCH, obs_mode="none", render_backend="none")
    env.reset(seed=0)
    base = env.unwrapped
    corner = (np.array(CONTAINER_OUTER) - BATTERY_SIZE) / 2 - CONTAINER_WALL
    place = torch.tensor([[WORKSPACE_XY[0] + corner[0], WORKSPACE_XY[1] + corner[1], float(base.battery.pose.p[0, 2])]])
    base.battery.set_pose(Pose.create_from_pq(place.float()))
    assert not base.failed(base.measure())


def test_the_time_at_the_goal_counts_on_in_a_state_that_is_at_the_goal(make_env):
    env = make_env(SEARCH, obs_mode="none", render_backend="none")
    env.reset(seed=0)
    base = env.unwrapped
    below = base.get_state_dict()
    lift(base.battery, 0.11)
    base._steps_at_goal[:] = 5
    state = base.get_state_dict()
    lift(base.battery, -0.01)
    base.set_state_dict(state)
    assert base.evaluate()["success"]
    base.set_state_dict(below)
    assert not base.evaluate()["success"]


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(
    ("aside", "height", "fails"), [(0.168, 0.0, False), (0.172, 0.0, True), (-0.172, 0.0, True), (0.172, 0.021, False)]
)
def test_a_battery_fails_outside_the_container_unless_it_is_lifted(make_env, axis, aside, height, fails):
    env = make_env(SEARCH, obs_mode="none", render_backend="none")
    env.reset(seed=0)
    base = env.unwrapped
    place = base.battery.pose.p.clone()
    place[:, :2] = torch.tensor(WORKSPACE_XY)
    place[:, axis] += aside
    place[:, 2] += height
    base.battery.set_pose(Pose.create_from_pq(place))
    assert bool(base.failed(base.measure())) is fails


@pytest.mark.parametrize(("height", "success"), [(0.119, False), (0.121, True), (0.199, True), (0.201, False)])
def test_the_papers_success_is_a_distance_of_the_battery(make_env, height, success):
    env = make_env(SEARCH, obs_mode="none", render_backend="none")
    env.reset(seed=0)
    base = env.unwrapped
    for aside in (0.0, 0.07):  # of the container's own position, 10 mm over the table
        up = np.sqrt(height**2 - aside**2)
        base.battery.set_pose(Pose.create_from_pq(torch.tensor([[0.5, aside, 0.01 + up]], dtype=torch.float32)))
        measures = base.measure()
        assert float(measures["distance"]) == pytest.approx(height, abs=1e-6)
        assert bool(base.paper_goal_reached(measures)) is success


@needs_renderer
def test_front_camera_cannot_see_into_the_container_unless_its_front_is_left_out(make_env):
    for occlusion in (True, False):
        env = make_env(SEARCH, obs_mode="rgb", occlusion=occlusion)
        pictures = []
        for x in (0.425, 0.575):
            env.reset(seed=0)
            base = env.unwrapped
            base.battery.set_pose(Pose.create_from_pq(torch.tensor([[x, 0.0, 0.0165]])))
            pictures.append(base.get_obs()["sensor_data"]["front"]["rgb"].int())
        assert bool((pictures[0] != pictures[1]).any()) is not occlusion


def test_lifting_the_battery_is_worth_as_much_as_reaching_it(make_env):
    env = make_env(SEARCH, obs_mode="none", render_backend="none")
    for height, share in ((-0.01, 0.0), (0.05, 0.5), (0.15, 1.0)):
        env.reset(seed=0)
        lift(env.unwrapped.battery, height)
        require_reward(env.unwrapped, env.unwrapped.battery, share)


def test_lifting_the_golf_ball_and_leaving_the_other_are_worth_the_same(make_env):
    env = make_env(SORTING, obs_mode="none", render_backend="none")
    for golf, tennis, worth in ((-0.01, 0.0, 1.0), (0.05, 0.0, 1.5), (0.15, 0.0, 2.0), (0.05, 0.011, 0.5)):
        env.reset(seed=0)
        lift(env.unwrapped.golf, golf)
        lift(env.unwrapped.tennis, tennis)
        require_reward(env.unwrapped, env.unwrapped.golf, worth)


def require_reward(base, reached, worth: float) -> None:
    """Check that the dense reward is what the distance of the tool from an object, other things and success are worth."""
    away = float(torch.linalg.norm(base.agent.tcp.pose.p - reached.pose.p))
    for success in (False, True):
        reward = base.compute_dense_reward(None, None, base.measure() | dict(success=torch.tensor([success])))
        assert float(reward) == pytest.approx(1 - np.tanh(8 * away) + worth + success, abs=5e-3)


@pytest.mark.parametrize(
    ("golf", "tennis", "goal"), [("golf", "tennis", True), ("tennis", "golf", False), ("golf", None, False)]
)
def test_each_ball_belongs_in_its_own_bowl(make_env, golf, tennis, goal):
    env = make_env(SORTING, obs_mode="none", render_backend="none", goal="bowls")
    env.reset(seed=0)
    base = env.unwrapped
    for ball, place in ((base.golf, golf), (base.tennis, tennis)):
        if place:
            ball.set_pose(Pose.create_from_pq(torch.tensor([[*BOWLS[place][0], 0.05]])))
    for _ in range(200):
        base.scene.step()
    assert bool(base.goal_reached(base.measure())) is goal
    assert not base.failed(base.measure()).any()


@pytest.mark.parametrize(
    ("height", "aside", "goal"), [(0.0, 0.0, True), (0.0, 0.02, True), (0.043, 0.0, False), (0.01, 0.06, False)]
)
def test_a_ball_over_or_beside_its_bowl_is_not_in_it(make_env, height, aside, goal):
    env = make_env(SORTING, obs_mode="none", render_backend="none", goal="bowls")
    env.reset(seed=0)
    base = env.unwrapped
    for ball in ("golf", "tennis"):
        (x, y), _ = BOWLS[ball]
        place = torch.tensor([[x + aside, y, BOWL_FLOOR + BALL_RADIUS + height]])
        getattr(base, ball).set_pose(Pose.create_from_pq(place))
    measures = base.measure()
    assert bool(base.goal_reached(measures)) is goal
    away = np.hypot(height, aside)
    assert [measures[f"{ball}_to_bowl"].item() for ball in ("golf", "tennis")] == pytest.approx([away, away], abs=1e-6)
    info = measures | dict(success=torch.tensor([goal]))
    reward = base.compute_dense_reward(None, None, info)
    assert reward.item() == pytest.approx(3 * (1 - np.tanh(4 * away)) + goal, abs=1e-5)
    info["tennis_to_bowl"] = info["tennis_to_bowl"] + 0.1  # each ball counts
    assert base.compute_dense_reward(None, None, info) < reward - 0.3


def test_a_ball_counts_when_the_hand_has_let_go_of_it(make_env):
    env = make_env(SORTING, obs_mode="none", render_backend="none", goal="bowls")
    env.reset(seed=0)
    base = env.unwrapped
    for ball, (xy, _) in BOWLS.items():
        getattr(base, ball).set_pose(Pose.create_from_pq(torch.tensor([[*xy, BOWL_FLOOR + BALL_RADIUS]])))
    over_rim = torch.tensor([[*BOWLS["tennis"][0], BOWL_HEIGHT + 0.019]])  # the fingertips are 1 mm over it
    width, force = 0.039, 3.0  # m between the gels' lower ends, which press on the ball over its middle; N
    base.agent.reset_tool(Pose.create_from_pq(over_rim, torch.tensor([POINTING_DOWN])), width / 2, force)
    base.agent.controller.reset()
    held = Skills(base).grip_action(width, force)
    for gripper, success in ((held, False), (1.0, True)):
        for _ in range(10):
            *_, info = env.step(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, gripper]))
        assert bool(base.agent.is_grasping(base.tennis)) is not success
        assert bool(info["success"]) is success


def test_the_instruction_is_that_of_the_goal(make_env):
    for goal, word in (("lift", "lift it"), ("bowls", "orange bowl")):
        env = make_env(SORTING, obs_mode="none", render_backend="none", goal=goal)
        (sentence,) = env.unwrapped.get_language_instruction()
        assert word in sentence
        assert sentence == task_spec(SORTING).instruction_for(dict(goal=goal))


def test_unknown_goal_is_refused(make_env):
    with pytest.raises(ValueError, match="goal='basket'"):
        make_env(SORTING, obs_mode="none", render_backend="none", goal="basket")


def test_success_comes_with_the_fifth_step_at_the_goal_in_a_row(make_env):
    env = make_env(SEARCH, obs_mode="none", render_backend="none")
    env.reset(seed=0)
    base = env.unwrapped
    base.battery._bodies[0].set_disable_gravity(True)
    down = base.battery.pose.raw_pose.clone()
    up = down + down.new_tensor([[0.0, 0.0, 0.15, 0.0, 0.0, 0.0, 0.0]])
    still, seen = np.zeros(env.action_space.shape, np.float32), []
    for lifted in [True] * 4 + [False] + [True] * 6:
        base.battery.set_pose(Pose.create(up if lifted else down))
        base.battery.set_linear_velocity(torch.zeros(1, 3))
        base.battery.set_angular_velocity(torch.zeros(1, 3))
        seen.append(bool(env.step(still)[-1]["success"]))
    assert seen == [False] * 9 + [True] * 2
