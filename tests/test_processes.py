"""Environments beside each other, after each other, and in processes that were forked or spawned."""

import multiprocessing
import subprocess
import sys

import gymnasium as gym
import numpy as np
import psutil
import pytest
import torch

from manifeel_ms3.rendering import backend
from manifeel_ms3.tasks.visuotactile_env import CAMERAS, SIDES
from tests.command_process import run_code
from tests.tasks_and_marks import PEG, needs_renderer

STEPS = 8
PATIENCE = 120  # s
OTHER = "ManiFeel-ObjectSearch-v1"


def rewards(env: gym.Env, steps: int = STEPS):
    """Rewards of a short episode, one by one."""
    env.reset(seed=3)
    for t in range(steps):
        action = np.full(env.action_space.shape, 0.2 * (-1) ** t, np.float32)
        yield env.step(action)[1].item()


def test_two_environments_do_not_disturb_each_other(make_env):
    first, second = (make_env(task, obs_mode="state", render_backend="none") for task in (PEG, OTHER))
    alone = list(rewards(first)), list(rewards(second))
    together = tuple(zip(*zip(rewards(first), rewards(second), strict=True), strict=True))
    assert [list(values) for values in together] == list(alone)


def _answer(connection, kwargs: dict, prepare=lambda: None) -> None:
    import manifeel_ms3  # noqa: F401

    prepare()
    try:
        env = gym.make(PEG, sim_backend="physx_cpu", **kwargs)
        connection.send(list(rewards(env, 2)))
        env.close()
    except RuntimeError as error:
        connection.send(str(error))


def _in_process(how: str, kwargs: dict, *prepare):
    context = multiprocessing.get_context(how)
    here, there = context.Pipe()
    process = context.Process(target=_answer, args=(there, kwargs, *prepare))
    process.start()
    try:
        assert here.poll(PATIENCE), "it hangs"
        return here.recv()
    finally:
        process.kill()
        process.join()


@pytest.fixture
def threads():
    """Torch with threads that are at work, as it is where nobody sets their number."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    torch.rand(512, 512) @ torch.rand(512, 512)
    torch.rand(1 << 20).sin()
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("how", ["fork", "spawn"])
def test_in_another_process_while_there_is_one_here(make_env, how, threads):
    here = make_env(obs_mode="tacff", render_backend="none")
    expected = list(rewards(here, 2))
    assert _in_process(how, dict(obs_mode="tacff", render_backend="none")) == expected
    assert list(rewards(here, 2)) == expected


def _use_cuda_as_after_a_fork() -> None:
    """Let torch behave as in a process that was forked from one that has used CUDA."""

    def refuse(*_args):
        raise RuntimeError("Cannot re-initialize CUDA in forked subprocess")

    torch.cuda.is_available, torch.cuda.device_count = lambda: True, lambda: 1
    torch.cuda._is_in_bad_fork, torch.cuda.get_rng_state = lambda: True, refuse


def test_in_a_process_that_was_forked_from_one_with_cuda():
    bare = dict(obs_mode="tacff", render_backend="none")
    assert len(_in_process("fork", bare, _use_cuda_as_after_a_fork)) == 2


IMPORTED_AFTER_THE_FORK = """
from tests.test_processes import _use_cuda_as_after_a_fork
_use_cuda_as_after_a_fork()
import gymnasium
print(gymnasium.make("ManiFeel-PegInsertion-v1", obs_mode="tacff", render_backend="none").reset(seed=0)[1])
"""


def test_the_package_is_imported_in_a_process_that_was_forked_from_one_with_cuda(tmp_path):
    done = run_code(IMPORTED_AFTER_THE_FORK, folder=tmp_path)
    assert done.returncode == 0, done.stderr


def test_a_process_keeps_its_renderer(monkeypatch):
    """SAPIEN renders on one device per process."""
    monkeypatch.setattr(backend, "_first_that_works", lambda: "gpu")
    for name, value in (("_renders_in", None), ("_renders_on", None)):
        monkeypatch.setattr(backend, name, value)
    assert [backend.available_render_backend(asked) for asked in ("cpu", "auto", "none", "auto")] == [
        "cpu",
        "cpu",
        "none",
        "cpu",
    ]


@pytest.mark.parametrize(
    ("asked", "device"),
    [
        ("gpu", "cuda"),
        ("cuda", "cuda"),
        ("sapien_cuda:1", "cuda:1"),
        ("cpu", "cpu"),
        ("sapien_cpu", "cpu"),
        ("pci:01:00", "pci:01:00"),
    ],
)
def test_the_device_that_is_tried_is_the_one_that_maniskill_would_render_on(monkeypatch, asked, device):
    tried = []
    monkeypatch.setattr(backend.sapien, "Device", lambda name: tried.append(name) or name)
    monkeypatch.setattr(backend.sapien.render, "RenderSystem", lambda _device: None)
    assert backend._works.__wrapped__(asked)
    assert tried == [device]


def test_the_cpu_renders_where_maniskills_tools_ask_for_a_gpu_and_there_is_none(monkeypatch, caplog):
    monkeypatch.setattr(backend, "_works", lambda name: name == "cpu")
    for name, value in (("_renders_in", None), ("_renders_on", None)):
        monkeypatch.setattr(backend, name, value)
    asked = ("gpu", "sapien_cuda", "gpu:1", "pci:01:00")
    assert [backend.available_render_backend(name) for name in asked] == ["cpu", "cpu", "none", "none"]
    assert caplog.text.count("there is no such device; the CPU renders in its place") == 2


@needs_renderer
def test_a_renderer_does_not_come_along_with_a_fork(make_env):
    make_env(obs_mode="rgb").reset(seed=0)
    assert "forked from one that has its own" in _in_process("fork", dict(obs_mode="rgb"))
    assert len(_in_process("fork", dict(obs_mode="tacff"))) == 2  # needs none


@pytest.mark.slow
@needs_renderer
def test_opened_and_closed_fifty_times(figure):
    process = psutil.Process()
    sizes, files = [], []
    for i in range(50):
        env = gym.make(PEG, obs_mode="rgb+tacrgb+tacff", sim_backend="physx_cpu")
        env.reset(seed=i)
        env.step(env.action_space.sample())
        env.close()
        sizes.append(process.memory_info().rss / 1e6)
        files.append(process.num_fds())
    figure("memory after 50 environments more than after 10, MB", sizes[-1] - sizes[9], at_most=50)
    assert files[-1] == files[9]


@pytest.mark.slow
@needs_renderer
def test_ten_thousand_steps_with_all_sensors(make_env, figure):
    env = make_env(obs_mode="rgb+tacrgb+tacff", cameras=CAMERAS, tactile_sensors=SIDES)
    process = psutil.Process()
    sizes = []
    for episode in range(100):
        env.reset(seed=episode)
        for _ in range(100):
            obs, *_ = env.step(env.action_space.sample())
        assert torch.isfinite(obs["sensor_data"]["tactile_right"]["force_field"]).all()
        sizes.append(process.memory_info().rss / 1e6)
    figure("memory after 100 episodes more than after 5, MB", sizes[-1] - sizes[4], at_most=50)


@pytest.mark.parametrize(
    ("mode", "shape"), [("tacff", "(2, 10, 14, 3)"), ("state+tacff", "(2, 10, 14, 3)"), ("state", "(2, 39)")]
)
def test_gymnasiums_vector_env_runs_in_its_default_mode_with_no_other_environment_alive(mode, shape):
    """It forks, after it has made and closed an environment of its own; in a process of its own, which has no other."""
    program = f"""
import gymnasium, manifeel_ms3
from gymnasium.vector import AsyncVectorEnv
from mani_skill.utils.wrappers import CPUGymWrapper
make = lambda: CPUGymWrapper(gymnasium.make({PEG!r}, obs_mode={mode!r}))
envs = AsyncVectorEnv([make, make])
obs, _ = envs.reset(seed=0)
obs, *_ = envs.step(envs.action_space.sample())
print((obs if {mode!r} == "state" else obs["sensor_data"]["tactile_right"]["force_field"]).shape)
envs.close()
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, timeout=2 * PATIENCE)
    assert shape in done.stdout, done.stderr
