"""States of an environment as vectors."""

from collections.abc import Iterator, Mapping
from typing import Any

import torch

from manifeel_ms3.errors import InvalidArgumentError

Tree = Mapping[str, Any]
"""Nested dicts of tensors (N, D)."""


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
