"""Shared fixtures. Tests run on the real simulator; those that need images are skipped only where there is no renderer."""

import gc
from collections import Counter
from pathlib import Path

import gymnasium as gym
import pytest
import torch

import manifeel_ms3  # noqa: F401
from manifeel_ms3.sensors.warp_device import warp_device
from tests.tasks_and_marks import PEG
from tests.tiny_study import TINY

torch.set_num_threads(1)
warp_device(torch.device("cpu"))  # where touch was never computed, this says so: here, and in no test
LONG = ("test_studies", "test_training", "test_end_to_end", "test_recorders", "test_experts", "test_engine", "test_record")
"""Names of files whose tests take minutes; they come in this order, so that none is left for the end."""


def pytest_collection_modifyitems(items):
    """Run long files first, so that no process waits for one at the end; skip tests marked `gpu` where there is none.

    Slow tests have no time limit.
    """
    items.sort(key=lambda item: LONG.index(item.path.stem) if item.path.stem in LONG else len(LONG))
    for item in items:
        if item.get_closest_marker("slow"):
            item.add_marker(pytest.mark.timeout(0))
    if not torch.cuda.is_available():
        for item in items:
            if item.get_closest_marker("gpu"):
                item.add_marker(pytest.mark.skip(reason="needs a CUDA GPU"))


def pytest_collection_finish():
    """Keep the modules that are imported out of the garbage collection that ManiSkill starts at every reset."""
    gc.freeze()


@pytest.fixture(scope="module")
def make_env():
    """A `gym.make` whose environments are closed after the tests of a module."""
    made = []

    def make(env_id: str = PEG, **kwargs):
        kwargs = dict(sim_backend="physx_cpu") | kwargs
        made.append(gym.make(env_id, **kwargs))
        return made[-1]

    yield make
    for env in made:
        env.close()


@pytest.fixture
def study(tmp_path) -> Path:
    """File of the tiny study."""
    path = tmp_path / "tiny.yaml"
    path.write_text(TINY)
    return path


@pytest.fixture
def figure(record_property):
    """Compare a measured number with its bound; the end of the test run reports the worst of each kind."""

    def check(what: str, value: float, at_most: float | None = None, at_least: float | None = None) -> None:
        record_property("figure", [what, float(value), at_most, at_least])
        assert at_most is None or value <= at_most, what
        assert at_least is None or value >= at_least, what

    return check


def pytest_terminal_summary(terminalreporter):
    worst, count = {}, Counter()
    for report in terminalreporter.stats.get("passed", []):
        for what, value, at_most, at_least in (made for name, made in report.user_properties if name == "figure"):
            count[what] += 1
            if what not in worst or (value > worst[what][0]) == (at_least is None):
                worst[what] = value, f"at least {at_least:g}" if at_most is None else f"at most {at_most:g}"
    for what, (value, wanted) in sorted(worst.items()):
        terminalreporter.write_line(f"{what}: {value:.3g} (worst of {count[what]}; {wanted})")
