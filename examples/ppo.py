"""PPO on joint states and touch, with the arguments of ManiSkill's `ppo.py`: `python examples/ppo.py`.

The observation is a vector of the state and of the right pad's force field, made by `FlattenVisuotactileObservationWrapper`.
Each environment simulates on the CPU in a process of its own. To do the same on a GPU, ManiSkill's own `ppo.py` would need the
two wrappers of `WRAPPERS`, which was not tried.
"""

import json
import logging
import random
import time
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
import tyro
from gymnasium.vector import AsyncVectorEnv, AutoresetMode
from mani_skill.utils.wrappers import CPUGymWrapper, RecordEpisode
from mani_skill.utils.wrappers.flatten import FlattenObservationWrapper
from torch import nn
from torch.distributions import Normal
from torch.utils.tensorboard import SummaryWriter

import manifeel_ms3  # noqa: F401  (registers the tasks)
from manifeel_ms3.tasks.registry import FIRST_EVALUATION_SEED
from manifeel_ms3.wrappers import FlattenVisuotactileObservationWrapper

WRAPPERS = (partial(FlattenVisuotactileObservationWrapper, flat_tacff=True), FlattenObservationWrapper)
EASY = dict(socket_xy=0.0, start_xy=0.005, start_z=0.0, start_rotation=0.0, in_hand_pitch=0.0)
"""Ranges with which the peg starts upright, up to 5 mm along x and y from the axis of a socket that stays where it is."""
FIRST_VALIDATION_SEED = FIRST_EVALUATION_SEED // 2
"""Seed of the first environment in an evaluation; the next ones have the following seeds. The seeds of `manifeel eval` are held
out, since weights may be chosen, and settings tuned, by the evaluations during training."""
HIDDEN = 256
"""Number of features of each hidden layer, as in ManiSkill's ppo.py."""
ACTOR_GAIN, CRITIC_GAIN = 0.01, 1.0
"""Gains of the orthogonal initial weights of the last layers; small for the actor, so that actions start near 0."""
FIRST_LOGSTD = -1.6
"""Logarithm of the actions' standard deviation (0.2) before training; set once, not tuned."""
FIRST_COUNT, VARIANCE_EPS, MAX_OBS = 1e-4, 1e-4, 5.0
"""Count with which the running normalisation of observations begins, number that is added to their variance, and limit of
normalised observations; set once, not tuned."""
ADAM_EPS, ADVANTAGE_EPS = 1e-5, 1e-8
"""Epsilon of Adam, and number that is added to the standard deviation of advantages, as in ManiSkill's ppo.py."""


FILMED = dict(render_mode="rgb_array", human_render_camera_configs=dict(width=256, height=256))
"""Arguments of the environment that is filmed; smaller than the task's own videos, which take seconds an image on a CPU."""


@dataclass
class Args:
    env_id: str = "ManiFeel-PegInsertion-v1"
    """Id of the task."""
    env_kwargs: str = json.dumps(dict(randomization=EASY, max_episode_steps=32))
    """Arguments of the task as json. By default the task is easier than the paper's (see EASY) and its episodes are short."""
    obs_mode: str = "state+tacff"
    """Observation mode."""
    control_mode: str | None = None
    """Control mode; the task's own if not given."""
    exp_name: str = "ppo"
    """Name of the run, whose log and weights are in runs/<exp_name>."""
    seed: int = 1
    """Seed of the networks, the environments and the actions."""
    fixed_actions: str = json.dumps({2: -0.5, 3: 0.0, 4: 0.0, 5: 0.0})
    """Actions that the policy does not choose, by their index, as json. By default the tool descends by 5 mm in every step and
    does not turn, so that the policy steers it along x and y; '{}' fixes none."""
    total_timesteps: int = 40_960
    """Number of environment steps."""
    track: bool = False
    """Whether Weights & Biases gets the log, too."""
    wandb_project_name: str = "ManiSkill"
    """Project of Weights & Biases."""
    wandb_entity: str | None = None
    """User or team of Weights & Biases; the user's default if not given."""
    capture_video: bool = False
    """Whether the first environment of every evaluation is filmed, to runs/<exp_name>/videos; this needs a renderer."""
    save_model: bool = True
    """Whether to write the weights to runs/<exp_name>/ckpt_<update>.pt at every evaluation."""
    evaluate: bool = False
    """Evaluate the weights of `checkpoint` and do not train."""
    checkpoint: Path | None = None
    """File of weights to start from."""
    learning_rate: float = 3e-4
    """Learning rate of Adam."""
    anneal_lr: bool = True
    """Whether the learning rate falls linearly to zero over the training."""
    num_envs: int = 4
    """Number of environments, each in a process of its own."""
    num_eval_envs: int = 4
    """Number of environments of an evaluation."""
    num_eval_steps: int = 128
    """Number of steps of each environment in an evaluation."""
    partial_reset: bool = False
    """Whether an episode of the training ends at success and failure, and not only at the time limit."""
    num_steps: int = 256
    """Number of steps of each environment between two updates."""
    eval_freq: int = 4
    """Number of updates between two evaluations."""
    gamma: float = 0.9
    """Discount factor."""
    gae_lambda: float = 0.9
    """Lambda of the generalized advantage estimation."""
    num_minibatches: int = 8
    """Number of minibatches of an epoch."""
    update_epochs: int = 8
    """Number of epochs of an update."""
    norm_adv: bool = True
    """Whether the advantages of a minibatch are normalised."""
    clip_coef: float = 0.2
    """Largest difference of the probability ratio from 1 before it is clipped."""
    clip_vloss: bool = False
    """Whether a value is clipped to `clip_coef` around the one of the rollout in the loss of the critic."""
    ent_coef: float = 0.0
    """Weight of the entropy of the actions, which is to be large."""
    vf_coef: float = 0.5
    """Weight of the loss of the critic."""
    max_grad_norm: float = 0.5
    """Largest norm of a gradient."""
    reward_scale: float = 1.0
    """Factor on the rewards of the training."""
    target_kl: float = 0.04
    """Largest Kullback-Leibler divergence between the policy and the one that collected the data; beyond it an update ends."""


class Agent(nn.Module):
    """Actor and critic, as in ManiSkill's ppo.py, behind a running normalisation of the observation."""

    def __init__(self, num_obs: int, num_actions: int):
        super().__init__()
        self.critic, actor = (self.mlp(num_obs, out, gain) for out, gain in ((1, CRITIC_GAIN), (num_actions, ACTOR_GAIN)))
        self.actor_mean = actor
        self.actor_logstd = nn.Parameter(torch.full((1, num_actions), FIRST_LOGSTD))
        self.register_buffer("mean", torch.zeros(num_obs))
        self.register_buffer("var", torch.ones(num_obs))
        self.register_buffer("count", torch.tensor(FIRST_COUNT))

    @staticmethod
    def mlp(num_in: int, num_out: int, last_gain: float) -> nn.Sequential:
        layers = [nn.Linear(a, b) for a, b in ((num_in, HIDDEN), (HIDDEN, HIDDEN), (HIDDEN, num_out))]
        for layer, gain in zip(layers, (2**0.5, 2**0.5, last_gain), strict=True):
            nn.init.orthogonal_(layer.weight, gain)
            nn.init.zeros_(layer.bias)
        return nn.Sequential(layers[0], nn.Tanh(), layers[1], nn.Tanh(), layers[2])

    def watch(self, obs: torch.Tensor) -> None:
        """Update the mean and variance of observations (N, D)."""
        delta, total = obs.mean(0) - self.mean, self.count + len(obs)
        between = delta**2 * self.count * len(obs) / total
        self.var = (self.var * self.count + obs.var(0, correction=0) * len(obs) + between) / total
        self.mean = self.mean + delta * len(obs) / total
        self.count = total

    def normalized(self, obs: torch.Tensor) -> torch.Tensor:
        return ((obs - self.mean) / (self.var + VARIANCE_EPS).sqrt()).clamp(-MAX_OBS, MAX_OBS)

    def value(self, obs: torch.Tensor) -> torch.Tensor:
        return self.critic(self.normalized(obs))[:, 0]

    def distribution(self, obs: torch.Tensor) -> Normal:
        return Normal(self.actor_mean(self.normalized(obs)), self.actor_logstd.exp())


class FixedActions(gym.ActionWrapper):
    """Some of the task's actions are fixed; the policy chooses the others."""

    def __init__(self, env: gym.Env, fixed: dict[int, float]):
        super().__init__(env)
        whole = env.action_space
        self._chosen = [i for i in range(len(whole.low)) if i not in fixed]
        self._whole = np.zeros_like(whole.low)
        self._whole[list(fixed)] = list(fixed.values())
        self.action_space = gym.spaces.Box(whole.low[self._chosen], whole.high[self._chosen], dtype=whole.dtype)

    def action(self, action: np.ndarray) -> np.ndarray:
        whole = self._whole.copy()
        whole[self._chosen] = action
        return whole


def make_env(args: Args, ignore_terminations: bool = False, videos: Path | None = None) -> gym.Env:
    """One environment with flat observations; its episodes are filmed where a folder of videos is given."""
    torch.set_num_threads(1)
    rendering = dict(render_backend="none") if videos is None else FILMED
    control = {} if args.control_mode is None else dict(control_mode=args.control_mode)
    env = gym.make(args.env_id, obs_mode=args.obs_mode, **control, **rendering, **json.loads(args.env_kwargs))
    for wrapper in WRAPPERS:
        env = wrapper(env)
    if videos is not None:
        env = RecordEpisode(env, str(videos), save_trajectory=False, max_steps_per_video=args.num_eval_steps)
    env = CPUGymWrapper(env, ignore_terminations=ignore_terminations, record_metrics=True)
    return FixedActions(env, {int(index): value for index, value in json.loads(args.fixed_actions).items()})


def make_envs(args: Args, num: int, videos: Path | None = None, **kwargs) -> AsyncVectorEnv:
    """Environments in processes of their own; the first is filmed where a folder of videos is given."""
    made = [partial(make_env, args, **kwargs)] * num
    made[0] = partial(made[0], videos=videos)
    return AsyncVectorEnv(made, context="spawn", autoreset_mode=AutoresetMode.SAME_STEP)


def tensor(array: np.ndarray) -> torch.Tensor:
    return torch.as_tensor(array, dtype=torch.float32)


@torch.no_grad()
def evaluate(args: Args, agent: Agent, envs: AsyncVectorEnv) -> dict[str, float]:
    """Mean metrics of episodes of the policy's mean actions, which run to the time limit."""
    obs, _ = envs.reset(seed=FIRST_VALIDATION_SEED)
    episodes = []
    for _ in range(args.num_eval_steps):
        obs, _, _, truncated, infos = envs.step(agent.distribution(tensor(obs)).mean.clamp(-1, 1).numpy())
        if truncated.all():
            episodes.append(infos["final_info"]["episode"])
    if not episodes:
        raise SystemExit(f"no episode ends in num_eval_steps={args.num_eval_steps}; give at least max_episode_steps")
    names = [name for name in episodes[0] if not name.startswith("_")]
    return {f"eval/{name}": float(np.mean([episode[name] for episode in episodes])) for name in names}


class Rollout:
    """The steps of all environments between two updates; every array is (T, N, ...): T steps of N environments."""

    def __init__(self, args: Args, envs: AsyncVectorEnv):
        shape = (args.num_steps, args.num_envs)
        self.obs = torch.zeros(*shape, *envs.single_observation_space.shape)
        self.actions = torch.zeros(*shape, *envs.single_action_space.shape)
        self.logprobs, self.rewards, self.values, self.dones, self.final_values = (torch.zeros(shape) for _ in range(5))

    @torch.no_grad()
    def collect(self, agent: Agent, envs: AsyncVectorEnv, obs: np.ndarray) -> tuple[np.ndarray, list[float]]:
        """Fill the arrays, and return the next observation and the success of each episode that ended."""
        successes = []
        self.final_values.zero_()
        for t in range(len(self.obs)):
            self.obs[t] = tensor(obs)
            distribution = agent.distribution(self.obs[t])
            self.actions[t] = distribution.sample()
            self.logprobs[t], self.values[t] = distribution.log_prob(self.actions[t]).sum(1), agent.value(self.obs[t])
            obs, reward, terminated, truncated, infos = envs.step(self.actions[t].clamp(-1, 1).numpy())
            done = terminated | truncated
            self.rewards[t], self.dones[t] = tensor(reward), tensor(done)
            if done.any():
                final = tensor(np.stack(list(infos["final_obs"][done])))
                self.final_values[t, torch.as_tensor(done)] = agent.value(final)
                successes += infos["final_info"]["episode"]["success_once"][done].astype(float).tolist()
        return obs, successes

    def advantages(self, args: Args, next_value: torch.Tensor) -> torch.Tensor:
        """Generalized advantage estimates (T, N); the return after an episode's end is the value of its last observation."""
        advantages, last = torch.zeros_like(self.rewards), torch.zeros(args.num_envs)
        for t in reversed(range(args.num_steps)):
            following = next_value if t == args.num_steps - 1 else self.values[t + 1]
            alive = 1 - self.dones[t]
            delta = (
                args.reward_scale * self.rewards[t] + args.gamma * (alive * following + self.final_values[t]) - self.values[t]
            )
            advantages[t] = last = delta + args.gamma * args.gae_lambda * alive * last
        return advantages


def update(args: Args, agent: Agent, optimizer: torch.optim.Optimizer, rollout: Rollout, advantages: torch.Tensor) -> dict:
    """Improve actor and critic on a rollout, and return the scalars to log."""
    returns = (advantages + rollout.values).flatten()
    obs, actions = rollout.obs.flatten(0, 1), rollout.actions.flatten(0, 1)
    old_logprobs, advantages = rollout.logprobs.flatten(), advantages.flatten()
    losses = {}
    for _ in range(args.update_epochs):
        for batch in torch.randperm(len(obs)).chunk(args.num_minibatches):
            distribution = agent.distribution(obs[batch])
            logratio = distribution.log_prob(actions[batch]).sum(1) - old_logprobs[batch]
            ratio = logratio.exp()
            divergence = ((ratio - 1) - logratio).mean().item()
            if divergence > args.target_kl:
                return losses
            advantage = advantages[batch]
            if args.norm_adv:
                advantage = (advantage - advantage.mean()) / (advantage.std() + ADVANTAGE_EPS)
            clipped = ratio.clamp(1 - args.clip_coef, 1 + args.clip_coef)
            policy_loss = -torch.min(advantage * ratio, advantage * clipped).mean()
            value, old = agent.value(obs[batch]), rollout.values.flatten()[batch]
            errors = (value - returns[batch]).square()
            if args.clip_vloss:
                near = old + (value - old).clamp(-args.clip_coef, args.clip_coef)
                errors = torch.max(errors, (near - returns[batch]).square())
            value_loss = 0.5 * errors.mean()
            entropy = distribution.entropy().sum(1).mean()
            loss = policy_loss + args.vf_coef * value_loss - args.ent_coef * entropy
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(agent.parameters(), args.max_grad_norm)
            optimizer.step()
            losses = {"losses/policy_loss": policy_loss.item(), "losses/value_loss": value_loss.item()}
            losses |= {"losses/approx_kl": divergence}
    return losses


def train(args: Args, agent: Agent, envs: AsyncVectorEnv, eval_envs: AsyncVectorEnv, folder: Path) -> dict[str, float]:
    """Train an agent, and return the metrics of the last evaluation."""
    writer, log = SummaryWriter(str(folder)), (folder / "log.jsonl").open("w")
    optimizer = torch.optim.Adam(agent.parameters(), args.learning_rate, eps=ADAM_EPS)
    rollout, (obs, _), begin, metrics = Rollout(args, envs), envs.reset(seed=args.seed), time.time(), {}
    if not args.checkpoint:
        agent.watch(tensor(obs))
    num_updates = args.total_timesteps // (args.num_envs * args.num_steps)
    for iteration in range(num_updates + 1):
        step = iteration * args.num_envs * args.num_steps
        scalars = {}
        if iteration % args.eval_freq == 0 or iteration == num_updates:
            scalars = metrics = evaluate(args, agent, eval_envs)
            if args.save_model:
                torch.save(agent.state_dict(), folder / f"ckpt_{iteration}.pt")
        if iteration < num_updates:
            if args.anneal_lr:
                optimizer.param_groups[0]["lr"] = args.learning_rate * (1 - iteration / num_updates)
            obs, successes = rollout.collect(agent, envs, obs)
            advantages = rollout.advantages(args, agent.value(tensor(obs)).detach())
            scalars = scalars | update(args, agent, optimizer, rollout, advantages)
            agent.watch(rollout.obs.flatten(0, 1))
            scalars |= {"charts/learning_rate": optimizer.param_groups[0]["lr"]}
            scalars |= {"train/reward": rollout.rewards.mean().item(), "time/total": time.time() - begin}
            scalars |= {"train/success_once": float(np.mean(successes))} if successes else {}
        for name, value in scalars.items():
            writer.add_scalar(name, value, step)
        log.write(json.dumps(dict(step=step) | scalars) + "\n")
        log.flush()
        logging.info("%d: %s", step, {name: round(value, 3) for name, value in scalars.items()})
    return metrics


def main(args: Args) -> dict[str, float]:
    """Train or evaluate, and return the metrics of the last evaluation."""
    if args.evaluate and not args.checkpoint:
        raise SystemExit("--evaluate needs --checkpoint, the file of the weights")
    if args.checkpoint and not Path(args.checkpoint).is_file():
        raise SystemExit(f"--checkpoint {args.checkpoint} does not exist; give a file of weights, such as runs/ppo/ckpt_40.pt")
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    torch.set_num_threads(1)  # networks this small gain nothing from more, and lose much where other processes run
    torch.manual_seed(args.seed)
    random.seed(args.seed)
    folder = Path("runs") / args.exp_name
    if args.track:
        import wandb  # not above, where every process of an environment would import it

        names = dict(project=args.wandb_project_name, entity=args.wandb_entity, name=args.exp_name, dir=str(folder.resolve()))
        wandb.init(**names, config=asdict(args), sync_tensorboard=True, group="PPO", tags=["ppo", args.env_id])
    videos = folder / "videos" if args.capture_video else None
    eval_envs = make_envs(args, args.num_eval_envs, videos, ignore_terminations=True)
    agent = Agent(eval_envs.single_observation_space.shape[0], eval_envs.single_action_space.shape[0])
    if args.checkpoint:
        agent.load_state_dict(torch.load(args.checkpoint, weights_only=True))
    if args.evaluate:
        metrics = evaluate(args, agent, eval_envs)
        logging.info("%s", {name: round(value, 3) for name, value in metrics.items()})
    else:
        envs = make_envs(args, args.num_envs, ignore_terminations=not args.partial_reset)
        metrics = train(args, agent, envs, eval_envs, folder)
        envs.close()
    eval_envs.close()
    if args.track:
        wandb.finish()
    return metrics


if __name__ == "__main__":
    main(tyro.cli(Args))
