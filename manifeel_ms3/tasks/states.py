"""States of an environment: how they are set, and their forms as trees and as vectors."""

# pyright: reportArgumentType=false, reportIncompatibleMethodOverride=false
# (ManiSkill annotates states as tensors, and has dicts of them)
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from mani_skill.utils import common

from manifeel_ms3.arguments import by_name
from manifeel_ms3.errors import InvalidArgumentError

from .sensing import SensingEnv

Tree = Mapping[str, Any]
"""Nested dicts of tensors (N, D)."""


class RestorableEnv(SensingEnv):
    """An environment whose states can be set, with the forces and the controllers' targets that belong to them."""

    def _state_has_changed(self, changed: torch.Tensor | slice, joint_forces: torch.Tensor | None) -> None:
        """Do what a task must do after a state was set.

        Args:
            changed: Indices of the environments whose state has changed.
            joint_forces: Forces and moments (N, L, 6), N and N m, of the joints of the robot's L links in the new state, if
                they are known.
        """
        raise NotImplementedError

    def get_state_dict(self) -> dict[str, Any]:
        """Copy of the present state; ManiSkill returns the controllers' own targets, which a reset changes."""
        return _copied(super().get_state_dict())

    def set_state_dict(self, state: dict, env_idx: torch.Tensor | None = None):
        """Set the state. Setting the present state again changes nothing.

        In particular, it keeps the engine's memory of contacts, which no state holds, and on which the last bits of an episode
        depend. Contact forces are no part of a state either. On the CPU, a physics step in the new state finds them, and then
        the state is set again; on a GPU, touch has the forces of the last state until the next step. Shear is that of a motion
        from the last state to this one.

        Args:
            state: Tree of tensors (n, D).
            env_idx: Indices (n,) of the environments whose states they are, in any order; all environments if None.
        """
        if env_idx is not None and len(env_idx) > 1:  # ManiSkill assigns the rows in rising order
            order = env_idx.argsort()
            env_idx, state = env_idx[order], rows(common.to_tensor(state, self.device), order)
        if self.num_envs == 1 and is_part_of(state, self.get_state_dict()):
            return
        self._set_all_of_state(state, env_idx)
        forces = None
        if not self.gpu_sim_enabled:
            self.scene.step()
            forces = self.agent.robot.get_link_incoming_joint_forces()
            self._set_all_of_state(state, env_idx)
        self._state_has_changed(slice(None) if env_idx is None else env_idx, forces)

    def set_state(self, state: Any, env_idx: torch.Tensor | None = None):
        """Set the state from the vectors (N, D) of `get_state`, which hold the controller's targets, too."""
        self.set_state_dict(unflattened(common.to_tensor(state, self.device), self._init_raw_state), env_idx)

    def _set_all_of_state(self, state: dict, env_idx: torch.Tensor | None) -> None:
        """Set the states of bodies and controllers."""
        super().set_state_dict(state, env_idx)
        if "controller" in state:  # ManiSkill's controllers take the states of all environments
            changed = slice(None) if env_idx is None else env_idx
            self.agent.set_controller_state(with_rows(self.agent.get_controller_state(), changed, state["controller"]))
            if self.gpu_sim_enabled:  # ManiSkill hands targets to the engine only with an action
                engine: Any = self.scene.px
                engine.gpu_apply_articulation_target_position()

    @contextmanager
    def _others_unchanged(self, env_idx: torch.Tensor) -> Iterator[None]:
        """Restore the other environments' states afterwards, with their controllers' targets; their pads are not read again."""
        others = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        others[env_idx] = False
        if not others.any():
            yield
            return
        running = others.nonzero()[:, 0]
        state, were_stale = rows(self.get_state_dict(), running), self._touch_is_stale[running].clone()
        try:
            yield
        finally:
            self._set_all_of_state(state, running)
            self._touch_is_stale[running] = were_stale


def take_given_state(options: dict[str, Any], env: RestorableEnv) -> Any:
    """Take the state in which an episode is to begin out of the options of a reset.

    Args:
        options: Options of the reset, from which the state is removed.
        env: Environment that is reset.

    Returns:
        The tree or the vectors that ManiSkill's option `reset_to_env_states` holds; None if it is not given.

    Raises:
        InvalidArgumentError: The option holds no state, or one of other bodies than the environment's.
    """
    given = options.pop("reset_to_env_states", None)
    if given is None:
        return None
    if not isinstance(given, Mapping) or "env_states" not in given:
        raise InvalidArgumentError(
            "the option reset_to_env_states holds no env_states; give dict(reset_to_env_states=dict(env_states=state)) with a "
            "state of get_state_dict or get_state"
        )
    state = given["env_states"]
    if isinstance(state, Mapping):
        _require_bodies_of(state, env.get_state_dict())
    return state


def _require_bodies_of(state: Tree, present: Tree) -> None:
    """Check that a state holds some of the bodies of an environment, and nothing that the environment does not have.

    A state may lack bodies and controllers, and its controllers may be those of another control mode.

    Raises:
        InvalidArgumentError: It does not.
    """
    bodies = {part: present.get(part, {}) for part in ("actors", "articulations")}
    given = {part: by_name(f"env_states[{part!r}]", state.get(part, {}), "that of get_state_dict") for part in bodies}
    unknown = sorted(map(str, set(state) - {*present, *bodies, "controller"}))
    unknown += [f"{part}/{name}" for part, held in given.items() for name in held if name not in bodies[part]]
    if unknown or not any(given.values()):
        raise InvalidArgumentError(
            f"the state in the option reset_to_env_states holds {unknown or 'no body'}; this environment has "
            f"{[f'{part}/{name}' for part, held in bodies.items() for name in held]}: give a state of its get_state_dict"
        )
    for part, held in given.items():
        _require_sizes(part, held, bodies[part])
    targets = present.get("controller", {})
    for part, held in state.get("controller", {}).items():
        _require_sizes(f"controller/{part}", held, targets.get(part, {}))


def _require_sizes(part: str, given: Tree, present: Tree) -> None:
    """Check that what is given has as many values for each environment as what has the same name at present.

    Raises:
        InvalidArgumentError: It does not.
    """
    for name in given.keys() & present.keys():
        size, wanted = (tuple(np.shape(common.to_numpy(tree[name])))[-1:] for tree in (given, present))
        if size != wanted:
            raise InvalidArgumentError(
                f"the state of {part}/{name} in the option reset_to_env_states has {size or 'no'} values for each "
                f"environment, and not {wanted}: give a state of get_state_dict"
            )


def unflattened(state: torch.Tensor, like: Tree) -> dict[str, Any]:
    """Tree of tensors (N, D) that a flat state holds side by side, in the tree's order.

    Args:
        state: Flat states (N, D), as ManiSkill's `get_state` returns them.
        like: A tree of the same form.

    Raises:
        InvalidArgumentError: The state has another number of columns than the tree.
    """
    widths = [leaf.shape[-1] for leaf in _leaves(like)]
    if state.ndim != 2 or state.shape[1] != sum(widths):
        raise InvalidArgumentError(f"a state of shape {tuple(state.shape)} is given; get_state returns (N, {sum(widths)})")
    return _filled(like, iter(state.split(widths, dim=1)))


def _copied(tree: Tree) -> dict[str, Any]:
    return {name: _copied(value) if isinstance(value, Mapping) else value.clone() for name, value in tree.items()}


def rows(tree: Tree, idx: torch.Tensor) -> dict[str, Any]:
    """Copy of the rows (n,) of a tree (N, D): a tree (n, D)."""
    return {name: rows(value, idx) if isinstance(value, Mapping) else value[idx] for name, value in tree.items()}


def with_rows(tree: Tree, idx: torch.Tensor | slice, given: Tree) -> dict[str, Any]:
    """Copy of what two trees have in common, (N, D), in which the rows `idx` (n,) are those that are given.

    Args:
        tree: Tree of tensors (N, D).
        idx: Indices (n,) of the rows.
        given: Tree of tensors or arrays, (n, D), or (D,) for a single row.
    """
    return {name: _with_rows(tree[name], idx, value) for name, value in given.items() if name in tree}


def _with_rows(value: Any, idx: torch.Tensor | slice, given: Any) -> Any:
    if isinstance(value, Mapping):
        return with_rows(value, idx, given)
    changed = value.clone()
    changed[idx] = torch.as_tensor(given).to(value).reshape(-1, value.shape[-1])
    return changed


def is_part_of(state: Tree, whole: Tree) -> bool:
    """Whether a tree (N, D) holds everything that another one of tensors or arrays, (N, D) or (D,), holds, bit for bit."""
    return all(_is_same(value, whole.get(name)) for name, value in state.items())


def _is_same(value: Any, other: Any) -> bool:
    if isinstance(value, Mapping):
        return isinstance(other, Mapping) and is_part_of(value, other)
    return isinstance(other, torch.Tensor) and torch.equal(torch.as_tensor(value).to(other).flatten(), other.flatten())


def _leaves(tree: Tree) -> Iterator[torch.Tensor]:
    for value in tree.values():
        yield from _leaves(value) if isinstance(value, Mapping) else [value]


def _filled(like: Tree, columns: Iterator[torch.Tensor]) -> dict[str, Any]:
    return {name: _filled(value, columns) if isinstance(value, Mapping) else next(columns) for name, value in like.items()}
