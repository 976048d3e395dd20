"""The examples work as the documentation says."""

import importlib.util
import json
import os
from pathlib import Path

import gymnasium as gym
import h5py
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from mani_skill.trajectory.dataset import ManiSkillTrajectoryDataset
from mani_skill.utils.wrappers import CPUGymWrapper, FlattenRGBDObservationWrapper

from manifeel_ms3.demonstrations.formats.demonstration_format import DemonstrationError
from manifeel_ms3.demonstrations.formats.maniskill_h5 import read_header
from manifeel_ms3.sensors import pad_pose
from manifeel_ms3.sensors.registry import SENSORS
from manifeel_ms3.tasks.registry import FIRST_EVALUATION_SEED
from manifeel_ms3.wrappers import PadsAsCamerasWrapper
from tests.sample import observed_sample, states_sample
from tests.tasks_and_marks import PEG, needs_renderer

EXAMPLES = Path(__file__).parents[1] / "examples"
MANISKILLS_FOLDER = "MANISKILL_DIFFUSION_POLICY"
"""Variable that names the folder `examples/baselines/diffusion_policy` of a clone of ManiSkill, which its package lacks."""


def load(name: str):
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def squeeze(env):
    """Close the fingers on PickCube's cube, and return the last observation."""
    env.reset(seed=0)
    env.cube.set_pose(env.agent.tcp.pose)
    closed = np.r_[env.agent.robot.get_qpos()[0, :7].numpy(), -1.0]
    for _ in range(10):
        obs, *_ = env.step(closed)
    return obs


@pytest.mark.parametrize("sensor", SENSORS)
def test_touch_in_a_stock_maniskill_task(sensor):
    """The Panda squeezes PickCube's cube: the field is what its finger feels."""
    load("touch_in_stock_task")
    code = [line for line in (EXAMPLES / "touch_in_stock_task.py").read_text().splitlines() if line.strip()]
    assert len(code) < 32
    options = dict(render_backend="none", control_mode="pd_joint_pos", sensor=sensor)
    env = gym.make("TouchPickCube-v1", obs_mode="state_dict", **options).unwrapped
    obs = squeeze(env)
    field = obs["extra"]["force_field"]
    contact = env.agent.robot.get_net_contact_forces(["panda_leftfinger"])[0, 0].norm().item()
    assert field[..., 0].sum().item() == pytest.approx(contact, rel=0.02)
    assert contact > 5.0
    assert obs["extra"]["rgb"].shape == (1, 240, 320, 3)
    env.close()
    vector, _ = gym.make("TouchPickCube-v1", obs_mode="state", **options).reset(seed=0)
    assert vector.shape[1] > 3 * 12 * 12


def test_a_pad_on_the_wrong_side_is_named(monkeypatch, caplog):
    """The pose of the left finger's pad, on the right finger: the gel is pulled, and reads zero."""
    example = load("touch_in_stock_task")
    monkeypatch.setattr(example, "LINK", "panda_rightfinger")
    env = example.TouchPickCubeEnv(obs_mode="state_dict", render_backend="none", control_mode="pd_joint_pos")
    squeeze(env)
    assert "'touch' is pulled by" in caplog.text
    assert caplog.text.count("faces away from what it touches") == 1
    env.close()
    caplog.clear()
    across = pad_pose(facing=(0, 1, 0), tip=(0, 0, 1), at=(0, 0, 0.0465))
    monkeypatch.setattr(example, "POSE", across)
    env = example.TouchPickCubeEnv(obs_mode="state_dict", render_backend="none", control_mode="pd_joint_pos")
    assert squeeze(env)["extra"]["force_field"][..., 0].sum().item() > 5.0
    assert not caplog.text
    env.close()


@needs_renderer
@pytest.mark.parametrize(("others", "actions"), [([], 6), (["ManiFeel-BallSorting-v1"], 7)])
def test_vla_eval_scores_a_model_on_tasks(others, actions, monkeypatch):
    """vla-eval's own loop, server and protocol; the model is a function that stands still and writes down what it is asked.

    One model also answers tasks that take another number of actions.
    """
    vla_eval = pytest.importorskip("vla_eval", reason="vla-eval is not installed")
    from vla_eval.model_servers.predict import PredictModelServer
    from vla_eval.specs import POSITION_DELTA

    asked = []

    class StandStill(PredictModelServer):
        def predict(self, obs, ctx):
            asked.append(obs)
            return {"actions": np.zeros(actions, np.float32)}

        def get_action_spec(self):
            return {"position": POSITION_DELTA}

        def get_observation_spec(self):
            return {}

    monkeypatch.syspath_prepend(str(EXAMPLES))
    params = dict(tasks=[PEG, *others], obs_mode="rgb+tacrgb+tacff", env_kwargs=dict(max_episode_steps=3))
    benchmark = dict(benchmark="vla_eval_benchmark:ManiFeelBenchmark", episodes_per_task=2, params=params)
    (result,) = vla_eval.evaluate(StandStill(), dict(benchmarks=[benchmark]), no_save=True)
    assert result["mean_success"] == 0.0
    for task in result["tasks"]:
        assert [episode["steps"] for episode in task["episodes"]] == [3, 3]
    assert len(asked) == 6 * len(result["tasks"]) == 6 + 6 * len(others)
    assert {name: image.shape for name, image in asked[0]["images"].items()} == dict(
        wrist=(256, 256, 3), tactile_right=(240, 320, 3)
    )
    assert asked[0]["task_description"] == "Insert the peg into the hole."
    assert np.shape(asked[0]["touch"]["right"]) == (10, 14, 3)
    assert not np.allclose(asked[0]["state"], asked[3]["state"])  # another initial state


def test_our_recordings_feed_the_loader_of_maniskills_diffusion_policy():
    """Its observations are those that the wrapper makes in evaluation."""
    example = load("diffusion_policy_loader")
    batch = example.main(observed_sample(PEG))
    assert batch["observations"]["rgb"].shape == (8, 2, 32, 32, 3)
    assert batch["observations"]["state"].shape == (8, 2, 25 + 420)
    assert batch["actions"].shape == (8, 16, 6)
    dataset = example.DiffusionPolicyDataset(observed_sample(PEG))
    first, last = dataset[0], dataset[len(dataset.actions[0]) - 1]
    assert np.array_equal(first["observations"]["state"][0], first["observations"]["state"][1])  # padded
    assert np.array_equal(last["actions"][1], dataset.actions[0][-1])
    with pytest.raises(
        DemonstrationError, match=r"holds no observations; `manifeel render-observations` makes a file with them"
    ):
        example.main(states_sample(PEG))


def test_maniskills_trajectory_dataset_reads_our_recordings():
    path = observed_sample(PEG)
    dataset = ManiSkillTrajectoryDataset(str(path), device="cpu", success_only=True)
    with h5py.File(path) as file:
        fields, actions = (file[f"traj_0/{name}"][()] for name in ("obs/sensor_data/tactile_right/force_field", "actions"))
    assert len(dataset) == sum(episode["elapsed_steps"] for episode in read_header(path)["episodes"])
    for step in (0, len(actions) - 1):
        sample = dataset[step]
        assert np.array_equal(sample["obs"]["sensor_data"]["tactile_right"]["force_field"], fields[step])
        assert np.array_equal(sample["action"], actions[step])
    assert dataset[len(actions) - 1]["success"]


@needs_renderer
def test_maniskills_own_loader_is_fed():
    folder = os.environ.get(MANISKILLS_FOLDER)
    if not folder:
        pytest.skip(f"{MANISKILLS_FOLDER} does not name ManiSkill's folder examples/baselines/diffusion_policy")
    example = load("diffusion_policy_loader")
    theirs = example.main(observed_sample(PEG), maniskill=Path(folder))
    ours = example.main(observed_sample(PEG))
    assert theirs["observations"]["rgb"].shape == ours["observations"]["rgb"].shape
    assert theirs["observations"]["state"].shape == ours["observations"]["state"].shape
    assert theirs["actions"].shape == ours["actions"].shape


@needs_renderer
def test_maniskills_loader_reads_what_its_evaluation_will_observe(make_env):
    """Its loader gives `obs_process_fn` dictionaries of arrays, with the entries and in the order of the environment's space.

    ManiSkill's package does not contain its loader, whose steps are written down here from its `train_rgbd.py`.
    """
    path = observed_sample(PEG)
    header = read_header(path)
    env = make_env(PEG, **header["env_info"]["env_kwargs"])
    with h5py.File(path) as file:
        recorded = arrays_like(file["traj_0/obs"], env.observation_space)
    processed = load("diffusion_policy_loader").obs_process_fn(recorded)
    observed, _ = FlattenRGBDObservationWrapper(PadsAsCamerasWrapper(env)).reset(seed=header["episodes"][0]["episode_seed"])
    assert set(processed) == {"rgb", "state"} == set(observed)
    assert processed["rgb"][:1] == pytest.approx(observed["rgb"].numpy(), abs=1)
    assert processed["state"][:1] == pytest.approx(observed["state"].numpy(), abs=1e-3)
    assert (processed["rgb"].dtype, processed["state"].dtype) == (np.uint8, np.float32)


def arrays_like(group: h5py.Group, space: gym.spaces.Dict) -> dict:
    """The arrays of a group that a space names, in the order of the space."""
    return {
        name: arrays_like(group[name], inner) if isinstance(inner, gym.spaces.Dict) else group[name][()]
        for name, inner in space.spaces.items()
    }


def test_ppo_improves_a_policy_on_what_it_observes():
    """The networks, the rollout's advantages and the update, without a simulator."""
    ppo = load("ppo")
    args = ppo.Args(num_steps=64, num_envs=4, num_minibatches=4, update_epochs=4, gamma=0.0)
    torch.manual_seed(0)
    agent = ppo.Agent(5, 2)
    envs = SyncVectorEnv([Aim] * args.num_envs, autoreset_mode=AutoresetMode.SAME_STEP)
    rollout, (obs, _) = ppo.Rollout(args, envs), envs.reset(seed=0)
    optimizer = torch.optim.Adam(agent.parameters(), 5e-4)
    rewards = []
    for _ in range(30):
        obs, _ = rollout.collect(agent, envs, obs)
        ppo.update(args, agent, optimizer, rollout, rollout.advantages(args, agent.value(ppo.tensor(obs)).detach()))
        agent.watch(rollout.obs.flatten(0, 1))
        rewards.append(rollout.rewards.mean().item())
    assert np.mean(rewards[-5:]) > np.mean(rewards[:5]) + 0.1


def test_ppo_can_fix_some_of_the_actions(make_env):
    ppo = load("ppo")
    env = CPUGymWrapper(make_env(PEG, obs_mode="state", render_backend="none"))
    env = ppo.FixedActions(env, {2: -0.5, 3: 0.0, 4: 0.0, 5: 0.0})
    env.reset(seed=0)
    before = env.unwrapped.agent.tcp_pose_at_base.raw_pose.clone()
    assert env.action_space.shape == (2,)
    for _ in range(10):
        env.step(np.array([0.2, 0.0], np.float32))
    moved = (env.unwrapped.agent.tcp_pose_at_base.raw_pose - before)[0]
    assert moved[0] == pytest.approx(0.02, abs=0.004)
    assert moved[2] == pytest.approx(-0.05, abs=0.01)
    assert moved[[1, 3, 4, 5, 6]].abs().max() < 2e-3


def test_ppo_evaluates_on_none_of_the_held_out_seeds():
    ppo = load("ppo")
    envs = SyncVectorEnv([Aim] * 3, autoreset_mode=AutoresetMode.SAME_STEP)
    ppo.evaluate(ppo.Args(num_eval_steps=8), ppo.Agent(5, 2), envs)
    seeds = [env.unwrapped.np_random_seed for env in envs.envs]
    assert len(set(seeds)) == 3
    assert max(seeds) < FIRST_EVALUATION_SEED


@pytest.fixture
def threads():
    """Number of threads, which the script sets for its whole process, given back after a test."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("threads")
def test_ppo_trains_on_a_task_and_evaluates_what_it_saved(tmp_path, monkeypatch):
    """ManiSkill's flags: `--save-model` writes weights, from which `--evaluate --checkpoint` makes the same numbers."""
    ppo = load("ppo")
    monkeypatch.chdir(tmp_path)
    few = dict(num_envs=1, num_eval_envs=1, num_steps=100, num_eval_steps=10, env_kwargs=json.dumps(dict(max_episode_steps=10)))
    trained = ppo.main(ppo.Args(exp_name="peg", total_timesteps=200, eval_freq=2, anneal_lr=True, learning_rate=1e-3, **few))
    assert sorted(path.name for path in Path("runs/peg").glob("*.pt")) == ["ckpt_0.pt", "ckpt_2.pt"]
    log = [json.loads(line) for line in Path("runs/peg/log.jsonl").read_text().splitlines()]
    assert [entry["step"] for entry in log] == [0, 100, 200]
    assert "losses/policy_loss" in log[1]
    assert [entry.get("charts/learning_rate") for entry in log] == [1e-3, 5e-4, None]
    assert trained["eval/return"] > 0.0
    checkpoint = Path("runs/peg/ckpt_2.pt")
    assert ppo.main(ppo.Args(evaluate=True, checkpoint=checkpoint, **few)) == pytest.approx(trained)


@needs_renderer
def test_ppo_makes_a_video_of_an_evaluation_and_is_tracked(tmp_path, monkeypatch):
    ppo = load("ppo")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WANDB_MODE", "offline")
    few = dict(num_eval_envs=1, num_envs=1, num_eval_steps=3, env_kwargs=json.dumps(dict(max_episode_steps=3)))
    ppo.main(ppo.Args(exp_name="video", total_timesteps=0, track=True, capture_video=True, **few))
    (video,) = Path("runs/video/videos").glob("*.mp4")
    assert video.stat().st_size > 0
    assert list(Path("runs/video/wandb").glob("offline-run-*/*.wandb"))


def test_ppo_needs_weights_to_evaluate():
    ppo = load("ppo")
    with pytest.raises(SystemExit, match="--evaluate needs --checkpoint"):
        ppo.main(ppo.Args(evaluate=True))


class Aim(gym.Env):
    """Rewards actions near the first two numbers of the observation; episodes have 8 steps."""

    observation_space = gym.spaces.Box(-1, 1, (5,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = 8
        return self._obs(), {}

    def _obs(self):
        self.seen = self.np_random.uniform(-1, 1, 5).astype(np.float32)
        return self.seen

    def step(self, action):
        self.left -= 1
        reward = -float(np.abs(action - self.seen[:2]).mean())
        return self._obs(), reward, False, self.left == 0, dict(episode=dict(success_once=False))
