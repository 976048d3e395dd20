"""Episodes: resets and states begin them anew, and each is a function of its seed and of its actions."""

import numpy as np
import pytest
import sapien
import torch
from mani_skill.sensors.camera import Camera

from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.experts import make_expert
from manifeel_ms3.sensors import TactileSensor
from manifeel_ms3.tasks.checks import check_seed, checked_reset
from manifeel_ms3.tasks.states import is_part_of


def rollout(env, seed, steps=6):
    obs, _ = env.reset(seed=seed)
    rng = np.random.default_rng(seed)
    out = [obs["sensor_data"]["tactile_right"]]
    for _ in range(steps):
        obs, *_ = env.step(rng.uniform(-1, 1, 6))
        out.append(obs["sensor_data"]["tactile_right"])
    return out, env.unwrapped.get_state()


def test_episode_is_a_function_of_its_seed_bit_for_bit(make_env):
    env = make_env(obs_mode="tacrgb+tacff", render_backend="none")
    touch, state = rollout(env, seed=3)
    rollout(env, seed=4)
    again, state_again = rollout(env, seed=3)
    fresh, state_fresh = rollout(make_env(obs_mode="tacrgb+tacff", render_backend="none"), seed=3)
    assert torch.equal(state, state_again)
    assert torch.equal(state, state_fresh)
    for first, second, third in zip(touch, again, fresh, strict=True):
        for key in first:
            assert torch.equal(first[key], second[key])
            assert torch.equal(first[key], third[key])


def test_setting_the_present_state_again_changes_nothing_bit_for_bit(make_env):
    env = make_env(obs_mode="tacff", render_backend="none")
    ends = []
    for sets in (False, True):
        env.reset(seed=3)
        for action in np.random.default_rng(3).uniform(-1, 1, (4, 6)):
            if sets:
                env.unwrapped.set_state_dict(env.unwrapped.get_state_dict())
            obs, *_ = env.step(action)
        ends.append((obs["sensor_data"]["tactile_right"]["force_field"], env.unwrapped.get_state()))
    assert all(map(torch.equal, *ends))


def test_environments_to_reset_can_be_listed(make_env):
    env = make_env(obs_mode="state", render_backend="none")
    first = env.reset(seed=1)[0]
    env.step(env.action_space.sample())
    assert env.reset(seed=1, options=dict(env_idx=[0]))[0].equal(first)


@pytest.mark.parametrize("env_idx", [[], [1], [-1], [0, 0], 0, [0.0], "a", torch.tensor([True])])
def test_what_is_no_list_of_environments_is_refused(make_env, env_idx):
    env = make_env(obs_mode="state", render_backend="none")
    env.reset(seed=1)
    before = env.step(np.full(6, 0.3))[0]
    with pytest.raises(InvalidArgumentError, match=r"env_idx=.*from 0 to 0"):
        env.reset(options=dict(env_idx=env_idx))
    assert torch.equal(env.unwrapped.get_obs(), before)


def test_a_list_without_a_seed_is_refused(make_env):
    with pytest.raises(InvalidArgumentError, match=r"seed=\[\]"):
        make_env(obs_mode="state", render_backend="none").reset(seed=[])


@pytest.mark.parametrize("seed", [-1, 2**32, 0.5, "0", [0, -1], [2**32], np.array([0.5]), np.array([[1]])], ids=str)
def test_what_is_no_seed_is_refused(seed):
    with pytest.raises(InvalidArgumentError, match=r"seed=.*from 0 to 2\*\*32 - 1"):
        check_seed(seed)
    for sound in (None, 5, np.int64(5), np.array(5), np.array([5, 6]), [0, 2**32 - 1]):
        check_seed(sound)


def test_seeds_that_are_not_one_for_each_of_several_environments_are_refused():
    for seed in (7, [7], [7, 8, 9]):
        seeds, env_idx = checked_reset(seed, None, 3, torch.device("cpu"))
        assert (seeds, env_idx.tolist()) == (seed, [0, 1, 2])
    for seed in ((7, 8, 9), np.array([7, 8, 9])):  # which ManiSkill does not take for a seed of each environment
        assert checked_reset(seed, None, 3, torch.device("cpu"))[0] == [7, 8, 9]
    with pytest.raises(InvalidArgumentError, match=r"seed=\[3, 4\] has 2 numbers.*3 in all"):
        checked_reset([3, 4], None, 3, torch.device("cpu"))


def test_looking_twice_changes_nothing(make_env):
    env = make_env(obs_mode="tacff", render_backend="none")
    env.reset(seed=0)
    obs, *_ = env.step(np.full(6, 0.5))
    twice = env.unwrapped.get_obs()
    assert torch.equal(obs["sensor_data"]["tactile_right"]["force_field"], twice["sensor_data"]["tactile_right"]["force_field"])


def test_info_is_that_of_its_step_for_good(make_env):
    env = make_env(obs_mode="state", render_backend="none")
    infos = [env.reset(seed=0)[1], *(env.step(np.zeros(6))[-1] for _ in range(2))]
    env.reset()
    assert [info["elapsed_steps"].item() for info in infos] == [0, 1, 2]


def test_changing_an_observation_does_not_change_the_sensors_reading(make_env):
    env = make_env(obs_mode="tacff", render_backend="none")
    field = env.reset(seed=0)[0]["sensor_data"]["tactile_right"]["force_field"]
    felt = field.clone()
    field.zero_()
    assert torch.equal(env.unwrapped.get_obs()["sensor_data"]["tactile_right"]["force_field"], felt)


def test_an_episode_without_a_seed_keeps_nothing_of_the_one_before(make_env):
    env = make_env(obs_mode="none", render_backend="none")
    env.reset(seed=0)
    env.step(np.zeros(6))
    base = env.unwrapped
    base._steps_at_goal[:], base._success_paper[:] = 5, True
    _, info = env.reset()
    assert not info["success"]
    assert not info["success_paper"]
    assert info["contact_force"] == 0
    assert info["elapsed_steps"] == 0


@pytest.mark.parametrize("mode", ["pd_ee_delta_pose_fixed_gripper", "pd_joint_target_delta_pos"])
def test_a_flat_state_holds_the_targets_of_arm_and_gripper(make_env, mode):
    """The same actions from the same state end in the same state, in an environment that was somewhere else before."""
    first, second = (make_env(obs_mode="none", render_backend="none", control_mode=mode) for _ in range(2))
    rng = np.random.default_rng(0)
    actions = rng.uniform(-0.3, 0.3, (8, *first.action_space.shape))
    ends = []
    first.reset(seed=0)
    for action in actions[:4]:
        first.step(action)
    state = first.unwrapped.get_state()
    for env, seed in ((first, 0), (second, 1)):
        env.reset(seed=seed)
        env.unwrapped.set_state(state)
        assert env.unwrapped.get_state() == pytest.approx(state, abs=1e-6)
        for action in actions[4:]:
            env.step(action)
        ends.append(env.unwrapped.get_state())
    assert ends[0] == pytest.approx(ends[1], abs=1e-3)
    with pytest.raises(ValueError, match=r"get_state returns \(N, "):
        first.unwrapped.set_state(state[:, :-1])


def test_every_episode_draws_its_own_touch_and_a_seed_begins_anew(make_env):
    """Without a seed ManiSkill keeps the last one in a reset; the draws of touch are new all the same."""
    kwargs = dict(imperfections=dict(gain=(0.0, 0.2)), tactile={"randomization.stiffness": 0.3})
    env = make_env(obs_mode="tacff", render_backend="none", **kwargs)

    def drawn() -> tuple[float, float]:
        sensor = env.unwrapped._tactile_sensors["tactile_right"]
        return sensor.drawn_imperfections["gain"].sum().item(), sensor.model._gel.normal_stiffness.sum().item()

    env.reset(seed=3)
    episodes = [drawn()]
    for _ in range(3):
        env.reset()
        episodes.append(drawn())
    assert all(len(set(values)) == 4 for values in zip(*episodes, strict=True))
    env.reset(seed=3)
    assert drawn() == episodes[0]
    env.reset()
    assert drawn() == episodes[1]


@pytest.mark.parametrize("seed", [None, 5])
@pytest.mark.parametrize("flat", [False, True])
def test_an_episode_that_begins_in_a_given_state_begins_anew(make_env, seed, flat):
    env = make_env(obs_mode="tacff", render_backend="none")
    base = env.unwrapped
    env.reset(seed=0)
    for _ in range(3):
        env.step(env.action_space.sample() * 0.3)
    tree, vector = base.get_state_dict(), base.get_state()
    base._steps_at_goal[:] = 5
    _, info = env.reset(seed=seed, options=dict(reset_to_env_states=dict(env_states=vector if flat else tree)))
    assert not info["success"]
    assert info["elapsed_steps"] == 0
    assert base.get_state() == pytest.approx(vector, abs=1e-6)
    with pytest.raises(InvalidArgumentError, match="holds no env_states; give"):
        env.reset(options=dict(reset_to_env_states=tree))


def test_a_state_of_other_bodies_does_not_begin_an_episode(make_env):
    env = make_env(obs_mode="tacff", render_backend="none")
    env.reset(seed=0)
    state = env.unwrapped.get_state_dict()
    body = torch.zeros(1, 13)
    for given, said in (
        ({}, "holds no body; this environment has .*articulations/panda_gelsight"),
        (dict(controller=state["controller"]), "holds no body"),
        (dict(actors={}), "holds no body"),
        (state | dict(goal=body), r"holds \['goal'\]"),
        (dict(actors=dict(cup=body), articulations=state["articulations"]), r"holds \['actors/cup'\]"),
        (state | dict(actors=dict(peg=torch.zeros(1, 3))), r"actors/peg .* has \(3,\) values .* and not \(13,\)"),
        (state | dict(actors=dict(peg="x")), r"actors/peg .* has no values"),
        (state | dict(controller=dict(arm=dict(target_pose=body))), r"controller/arm/target_pose .* has \(13,\) .* not \(7,\)"),
        (dict(actors=body), r"env_states\['actors'\]=.* must be a dict"),
    ):
        with pytest.raises(InvalidArgumentError, match=said):
            env.reset(options=dict(reset_to_env_states=dict(env_states=given)))
        assert is_part_of(state, env.unwrapped.get_state_dict())
    without_controller = dict(actors=state["actors"], articulations=state["articulations"])  # as other programs write it
    env.reset(options=dict(reset_to_env_states=dict(env_states=without_controller)))


@pytest.mark.parametrize(
    "mode",
    ["pd_ee_delta_pose", "pd_joint_pos", "pd_joint_delta_pos", "pd_joint_target_delta_pos", "pd_joint_pos_fixed_gripper"],
)
def test_a_state_holds_the_targets_of_all_drives(make_env, mode):
    env = make_env(obs_mode="none", render_backend="none", control_mode=mode)
    base = env.unwrapped
    env.reset(seed=0)
    action = np.full(env.action_space.shape, 0.3, np.float32)
    if mode.startswith("pd_joint_pos"):
        action[:7] = base.agent.robot.get_qpos()[0, :7] + 0.03
    if not mode.endswith("_fixed_gripper"):
        action[-1] = -0.9
    for _ in range(3):
        env.step(action)
    state, targets = base.get_state_dict(), base.agent.robot.get_drive_targets().clone()
    env.reset(seed=1)
    assert (base.agent.robot.get_drive_targets() - targets).abs().max() > 1e-3
    base.set_state_dict(state)
    assert base.agent.robot.get_drive_targets() == pytest.approx(targets, abs=1e-3 if "ee" in mode else 1e-6)
    assert is_part_of(state["controller"]["gripper"], base.get_state_dict()["controller"]["gripper"])


def test_what_the_fingers_hold_is_held_after_its_state_is_set(make_env):
    """The grip of a hand that an action has closed comes with the state, into an environment whose hand is open."""
    env = make_env("ManiFeel-ObjectSearch-v1", obs_mode="tacff", render_backend="none")
    env.reset(seed=1)
    for action in make_expert("ManiFeel-ObjectSearch-v1", env.unwrapped, 1).actions():
        obs, *_ = env.step(action)
        gripped = obs["sensor_data"]["tactile_right"]["force_field"][..., 0].sum().item()
        if gripped > 15:
            break
    assert gripped > 15
    state = env.unwrapped.get_state_dict()
    obs, _ = env.reset(seed=2, options=dict(reset_to_env_states=dict(env_states=state)))
    assert obs["sensor_data"]["tactile_right"]["force_field"][..., 0].sum().item() == pytest.approx(gripped, rel=0.1)


def test_a_reset_observes_once(make_env, monkeypatch):
    """Before the grip has settled, nothing is rendered and no pad is read."""
    env = make_env(obs_mode="rgb+tacff")
    calls = []
    for kind in (Camera, TactileSensor):
        capture = kind.capture
        monkeypatch.setattr(kind, "capture", lambda *args, capture=capture: (calls.append(args[0]), capture(*args))[1])
    for seed in (0, None):
        calls.clear()
        obs, _ = env.reset(seed=seed)
        assert len(calls) == len(obs["sensor_data"]) == 2


def test_touch_after_a_state_is_set_is_that_of_the_state(make_env):
    """Neither forces nor drives are part of a state; the gripped peg is felt again as soon as its state is set."""
    env = make_env(obs_mode="tacff", render_backend="none")
    base = env.unwrapped
    obs, _ = env.reset(seed=0)

    def pressing(obs) -> float:
        return obs["sensor_data"]["tactile_right"]["force_field"][..., 0].sum().item()

    gripped, force = base.get_state_dict(), pressing(obs)
    assert force > 10
    base.plug.set_pose(sapien.Pose([0.0, 0.6, 0.3]))
    for _ in range(8):
        obs, *_ = env.step(np.zeros(env.action_space.shape, np.float32))
    assert pressing(obs) == 0
    base._steps_at_goal[:] = 5
    base.set_state_dict(gripped)
    assert pressing(base.get_obs()) == pytest.approx(force, rel=0.01)
    assert base.evaluate()["contact_force"].item() == pytest.approx(9.81 * base.plug.mass.item(), rel=0.5)  # the peg's weight
    assert not base.evaluate()["success"]  # the peg is in the hand
