"""A thousand random inputs: a bad argument, action, seed or option is always refused by an error that names it; a damaged file
is refused by an error that names the file, unless the damage leaves it valid; and the environment works on after a refusal.
"""

import json
import random
import shutil
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from baselines.studies.study import read_study
from manifeel_ms3 import cli
from manifeel_ms3.arguments import is_number
from manifeel_ms3.demonstrations import summary, validate
from manifeel_ms3.demonstrations.formats import maniskill_h5
from manifeel_ms3.errors import ManifeelError
from manifeel_ms3.evaluation.checkpoint_config import checkpoint_config
from manifeel_ms3.evaluation.result import read_result
from manifeel_ms3.tasks.placement import REACH_XY
from tests.conftest import PEG

REPOSITORY = Path(__file__).parents[1]
SAMPLE = REPOSITORY / "data/sample" / PEG
RESULT = next((REPOSITORY / "leaderboard").rglob("0*.json"))


def bad(examples: int):
    return settings(
        max_examples=examples,
        deadline=None,
        derandomize=True,
        suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.filter_too_much],
    )


@contextmanager
def refused_or_valid(*names: object):
    """The code inside succeeds, or is refused by an error that names one of these; a `KeyError`, say, is a fault."""
    try:
        yield
    except ManifeelError as error:
        if not any(str(name) in str(error) for name in names):
            raise AssertionError(f"the error names none of {names}") from error


scalars = st.one_of(st.integers(), st.floats(), st.text(max_size=8), st.binary(max_size=8), st.just(True))
junk = st.one_of(
    scalars,
    st.lists(st.one_of(st.none(), scalars), min_size=1, max_size=4),
    st.dictionaries(
        st.one_of(scalars, st.sampled_from(["units", "gel.thickness", "socket_xy"])), scalars, min_size=1, max_size=3
    ),
).filter(bool)
json_junk = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(-9, 9), st.floats(allow_nan=False), st.text(max_size=5)),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=5), inner, max_size=3)),
    max_leaves=4,
)


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


def mutated(tree, chance: random.Random, value):
    """The tree with one place, anywhere in it, replaced by `value` or gone."""
    if chance.random() < 0.2 or not isinstance(tree, dict | list) or not tree:
        return value
    place = chance.choice(list(tree) if isinstance(tree, dict) else range(len(tree)))
    copy = tree.copy()
    if chance.random() < 0.3:
        del copy[place]
    else:
        copy[place] = mutated(tree[place], chance, value)
    return copy


def read_demonstrations(path: Path) -> None:
    maniskill_h5.read_demonstrations(path, ["extra/tcp_pose"])
    summary.summary(path)


JSON_READERS = {
    "trajectory.json": (SAMPLE / "trajectory.json", lambda path: read_demonstrations(path.with_suffix(".h5"))),
    "manifest.json": (SAMPLE.parent / "manifest.json", lambda path: validate.validate(path.parent)),
    "00000001.json": (RESULT, read_result),
    "config.json": (RESULT, lambda path: checkpoint_config(path.parent)),
    "study.yaml": (REPOSITORY / "configs/smoke.yaml", read_study),
}


@bad(300)
@given(name=st.sampled_from(sorted(JSON_READERS)), chance=st.randoms(use_true_random=False), value=json_junk, cut=st.booleans())
def test_json_files(tmp_path, name, chance, value, cut):
    source, read = JSON_READERS[name]
    path = tmp_path / name
    if name.startswith("trajectory"):
        shutil.copy(SAMPLE / "trajectory.h5", tmp_path)
    text = source.read_text()
    if cut or source.suffix == ".yaml":
        start = chance.randrange(len(text))
        path.write_text(text[:start] + chance.choice(["", str(value), "\0", "}"]) + text[start + chance.randrange(40) :])
    else:
        path.write_text(json.dumps(mutated(json.loads(text), chance, value)))
    with refused_or_valid(path, tmp_path):
        read(path)


@bad(100)
@given(chance=st.randoms(use_true_random=False), how=st.sampled_from(["cut", "flip", "remove"]))
def test_trajectory_files(tmp_path, chance, how):
    path = Path(shutil.copy(SAMPLE / "trajectory.h5", tmp_path))
    shutil.copy(SAMPLE / "trajectory.json", tmp_path)
    if how == "remove":
        with h5py.File(path, "r+") as file:
            names = []
            file.visit(names.append)
            del file[chance.choice(names)]
    else:
        content = bytearray(path.read_bytes())
        place = chance.randrange(len(content))
        if how == "cut":
            content = content[:place]
        else:
            content[place : place + 8] = chance.randbytes(8)
        path.write_bytes(content)
    with refused_or_valid(path):
        read_demonstrations(path)


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
