"""Rows of an environment's state are those of its parallel environments."""

import numpy as np
import torch

from manifeel_ms3.tasks.states import RestorableEnv, rows, with_rows


def state(first: float, num_envs: int) -> dict:
    """Targets that rise from one environment to the next."""
    arm = first + torch.arange(num_envs * 7.0).reshape(num_envs, 7)
    return dict(arm=dict(target_pose=arm), gripper=dict(target_qpos=first + arm[:, :2]))


def test_rows_are_replaced_in_these_environments_alone():
    whole, given, env_idx = state(0.0, 4), state(100.0, 2), torch.tensor([3, 1])
    changed = with_rows(whole, env_idx, given)
    for part, name in (("arm", "target_pose"), ("gripper", "target_qpos")):
        assert torch.equal(changed[part][name][[3, 1]], given[part][name])
        assert torch.equal(changed[part][name][[0, 2]], state(0.0, 4)[part][name][[0, 2]])
        assert torch.equal(whole[part][name], state(0.0, 4)[part][name])


class OfFour(RestorableEnv):
    """Four environments, of which nothing is there but what is set."""

    gpu_sim_enabled = True  # pyright: ignore[reportIncompatibleMethodOverride]
    num_envs, device = 4, torch.device("cpu")  # pyright: ignore[reportAssignmentType, reportIncompatibleMethodOverride]

    def __init__(self):
        self.was_set = []

    def _set_all_of_state(self, state, env_idx):
        self.was_set.append((state["arm"]["target_pose"][:, 0].tolist(), env_idx.tolist()))

    def _state_has_changed(self, changed, joint_forces): ...


def test_rows_are_set_in_rising_order_because_maniskill_assigns_them_so():
    env, given = OfFour(), state(100.0, 2)
    env.set_state_dict(given, torch.tensor([3, 1]))
    env.set_state_dict(given, torch.tensor([1, 3]))
    assert env.was_set == [([107.0, 100.0], [1, 3]), ([100.0, 107.0], [1, 3])]


def test_a_single_row_may_be_a_vector_and_parts_may_be_missing():
    changed = with_rows(state(0.0, 3), torch.tensor([2]), dict(arm=dict(target_pose=np.full(7, 9.0)), gripper={}, camera={}))
    assert changed["arm"]["target_pose"][2].tolist() == [9.0] * 7
    assert changed["gripper"] == {}
    assert "camera" not in changed


def test_rows_that_are_kept_do_not_change_with_the_state():
    whole = state(0.0, 3)
    kept = rows(whole, torch.tensor([0, 2]))
    whole["arm"]["target_pose"][:] = -1.0
    assert torch.equal(kept["arm"]["target_pose"], state(0.0, 3)["arm"]["target_pose"][[0, 2]])
