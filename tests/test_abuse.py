"""A thousand bad inputs: each is refused by an error that says so, and what it was given to works on."""

import json
import random
import shutil
from pathlib import Path

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
from manifeel_ms3.demonstrations import summary, validate
from manifeel_ms3.demonstrations.formats import maniskill_h5
from manifeel_ms3.evaluation.checkpoint_config import checkpoint_config
from manifeel_ms3.evaluation.result import read_result
from tests.conftest import PEG

REPOSITORY = Path(__file__).parents[1]
SAMPLE = REPOSITORY / "data/sample" / PEG
RESULT = next((REPOSITORY / "leaderboard").rglob("0*.json"))
REFUSED = (ValueError, RuntimeError)  # and whatever derives from them: never a KeyError, an IndexError, an AttributeError


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


@bad(250)
@given(argument=st.sampled_from(ARGUMENTS), value=junk)
def test_arguments_of_a_task(argument, value):
    try:
        gym.make(PEG, **(dict(obs_mode="tacff", render_backend="none") | {argument: value})).close()
    except REFUSED as error:
        assert argument in str(error)


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
    try:
        env.step(action)
    except REFUSED as error:
        assert "action" in str(error)
        assert torch.equal(env.unwrapped.elapsed_steps, before)  # refused before anything moved
    assert torch.isfinite(env.step(np.zeros(6, np.float32))[0]).all()


@bad(100)
@given(seed=st.one_of(st.none(), junk), options=st.one_of(st.none(), scalars.filter(bool)))
def test_resets(env, seed, options):
    try:
        env.reset(seed=seed, options=options)
    except REFUSED as error:
        assert "seed" in str(error) or "options" in str(error)
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
    try:
        read(path)
    except REFUSED as error:
        assert str(path) in str(error) or str(tmp_path) in str(error)


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
    try:
        read_demonstrations(path)
    except REFUSED as error:
        assert str(path) in str(error)


COMMANDS = sorted(set(cli.all_commands()) - {"teleop", "doctor", "dataset"})  # those would start
WORDS = (*COMMANDS, PEG, "--out", "--workers", "-1", "nan", "{", "--num", "cpu")


@bad(50)
@given(words=st.lists(st.sampled_from(WORDS), min_size=1, max_size=4))
def test_command_lines(words, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    if words[:2] == ["record", PEG]:
        words = [words[0], *words[2:]]  # that would be a good one
    try:
        assert cli.main(words) in (0, 1)
    except SystemExit as ended:
        assert ended.code in (0, 2)
