"""Hundreds of random inputs: a bad argument, action, seed or option is always refused by an error that names it, and the
environment works on after a refusal. Damaged files are in `trust/test_fuzzing.py`.
"""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from manifeel_ms3 import cli
from manifeel_ms3.arguments import is_number
from manifeel_ms3.errors import ManifeelError
from manifeel_ms3.tasks.placement import REACH_XY
from tests.tasks_and_marks import PEG


def bad(examples: int):
    return settings(
        max_examples=examples,
        deadline=None,
        derandomize=True,
        suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.filter_too_much],
    )


scalars = st.one_of(st.integers(), st.floats(), st.text(max_size=8), st.binary(max_size=8), st.just(True))
junk = st.one_of(
    scalars,
    st.lists(st.one_of(st.none(), scalars), min_size=1, max_size=4),
    st.dictionaries(
        st.one_of(scalars, st.sampled_from(["units", "gel.thickness", "socket_xy"])), scalars, min_size=1, max_size=3
    ),
).filter(bool)


@pytest.fixture(scope="module")
def env(make_env):
    env = make_env(obs_mode="state", render_backend="none")
    env.reset(seed=0)
    return env


ARGUMENTS = (
    "obs_mode",
    "cameras",
    "tactile_sensors",
    "tactile",
    "lighting",
    "occlusion",
    "randomization",
    "fit",
    "robot_uids",
    "num_envs",
)


def is_argument(argument: str, value: Any) -> bool:
    """Whether a random value happens to be one that the task takes."""
    if argument == "num_envs":
        return type(value) is int and value == 1
    if argument == "randomization":
        return isinstance(value, dict) and all(
            name == "socket_xy" and is_number(size) and 0 <= size <= REACH_XY for name, size in value.items()
        )
    if argument == "tactile":
        return isinstance(value, dict) and all(
            name == "gel.thickness" and is_number(size) and size > 0 for name, size in value.items()
        )
    return False


@bad(250)
@given(argument=st.sampled_from(ARGUMENTS), value=junk)
def test_arguments_of_a_task(argument, value):
    kwargs = dict(obs_mode="tacff", render_backend="none") | {argument: value}
    if is_argument(argument, value):
        gym.make(PEG, **kwargs).close()
    else:
        with pytest.raises(ManifeelError, match=argument):
            gym.make(PEG, **kwargs)


def is_action(action: Any) -> bool:
    """Whether a random value happens to be an action of the peg's task."""
    if not isinstance(action, np.ndarray) or action.shape not in ((6,), (1, 6)):
        return False
    with np.errstate(over="ignore"):
        return bool(np.isfinite(action.astype(np.float32)).all())


@bad(250)
@given(
    action=st.one_of(
        junk,
        arrays.arrays(np.float32, arrays.array_shapes(min_dims=0, max_dims=3, max_side=8), elements=st.floats(width=32)),
        arrays.arrays(np.float64, (6,), elements=st.floats()),
    )
)
def test_actions(env, action):
    before = env.unwrapped.elapsed_steps.clone()
    if is_action(action):
        env.step(action)
        assert torch.equal(env.unwrapped.elapsed_steps, before + 1)
    else:
        with pytest.raises(ManifeelError, match="action"):
            env.step(action)
        assert torch.equal(env.unwrapped.elapsed_steps, before)  # refused before anything moved
    assert torch.isfinite(env.step(np.zeros(6, np.float32))[0]).all()


def is_seed(seed: Any) -> bool:
    """Whether a random value happens to be a seed, or a list of seeds."""
    seeds = seed if isinstance(seed, list) else [seed]
    return seed is None or all(isinstance(one, int) and 0 <= one < 2**32 for one in seeds)


@bad(100)
@given(seed=st.one_of(st.none(), junk), options=st.one_of(st.none(), scalars.filter(bool)))
def test_resets(env, seed, options):
    if is_seed(seed) and options is None:
        env.reset(seed=seed)
    else:
        with pytest.raises(ManifeelError, match=r"seed|options"):
            env.reset(seed=seed, options=options)
    assert torch.isfinite(env.step(np.zeros(6, np.float32))[0]).all()


def test_after_all_that_an_episode_is_what_it_was(env, make_env):
    fresh = make_env(obs_mode="state", render_backend="none")
    for step in (lambda env: env.reset(seed=5)[0], lambda env: env.step(np.full(6, 0.3, np.float32))[0]):
        assert torch.equal(step(env), step(fresh))


COMMANDS = sorted(set(cli.all_commands()) - {"teleop", "doctor", "dataset"})  # those would start
WORDS = (*COMMANDS, PEG, "--out", "--workers", "-1", "nan", "{", "--num", "cpu")


@bad(50)
@given(words=st.lists(st.sampled_from(WORDS), min_size=1, max_size=4))
def test_command_lines(words, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    if words[:2] == ["record", PEG]:
        words = [words[0], *words[2:]]  # that would be a good one
    try:
        code = cli.main(words)
    except SystemExit as ended:  # of tyro: a help text or an argument that it refuses
        code = ended.code
    assert code in (0, 1, 2)
