"""What policies learn and execute, with networks whose best answer is known: the way from a demonstration to actions."""

from typing import Any

import numpy as np
import pytest
import torch

from baselines.common.action_chunks import ActionChunks
from baselines.common.checkpoint import WEIGHTS, read_tensors, write_tensors
from baselines.common.dataset import SequenceDataset
from baselines.common.observation import POSE, observation_spec
from baselines.common.policy import PolicyConfig, VisuotactilePolicy
from baselines.diffusion_policy import train as diffusion
from baselines.diffusion_policy.policy import DiffusionConfig, DiffusionPolicy
from baselines.equivariant_diffusion_policy.policy import EquivariantConfig
from baselines.flow_matching.policy import FlowConfig, FlowMatchingPolicy
from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.evaluation.policy import PolicyRequest, load_policy
from tests.trust.tiny_checkpoint import save_tiny_checkpoint

SPEC = observation_spec("none", (), (), 16)
STEPS = 30
"""Number of steps of the demonstration whose action and x coordinate count the steps."""
CLEAN = torch.linspace(-0.9, 0.9, 16 * 6).view(1, 16, 6)
"""The only normalised actions of a demonstration, for which the best answer of a network is known."""


def pose_at(step: float) -> np.ndarray:
    return np.array([step, 0, 0, 0, 1, 0, 0], np.float32)


def demonstration() -> dict[str, np.ndarray]:
    actions = np.arange(STEPS, dtype=np.float32)[:, None] / 100
    return {"actions": actions, POSE: np.stack([pose_at(step) for step in range(STEPS + 1)])}


def generators(count: int) -> list[torch.Generator]:
    return [torch.Generator().manual_seed(seed) for seed in range(count)]


class Recites(VisuotactilePolicy):
    """Generates what the demonstration does from the first observation of a window on, and knows it by the last one."""

    name = "recites"

    def make_networks(self):
        return torch.nn.Identity(), torch.nn.Identity()

    def generate(self, condition, steps, generators):
        last = self.obs_normalizer(POSE).restore(condition[POSE])[:, -1, :1]
        ahead = last + torch.arange(self.config.pred_horizon) - (self.config.obs_horizon - 1)
        return self.action_normalizer.normalize(ahead.clamp(0, STEPS - 1)[..., None] / 100)


def recites(**settings: Any) -> tuple[Recites, SequenceDataset]:
    """The policy, and the samples of the demonstration, to which it is fitted."""
    config = PolicyConfig(**settings)
    policy = Recites(config, SPEC, 1).eval()
    horizons = (config.obs_horizon, config.pred_horizon, config.action_horizon)
    data = SequenceDataset([demonstration()], SPEC, *horizons, torch.device("cpu"))
    policy.fit_normalizers(data.observations, data.actions)
    return policy, data


@pytest.mark.parametrize("horizons", [dict(), dict(obs_horizon=1, action_horizon=4), dict(obs_horizon=3, action_horizon=5)])
@pytest.mark.parametrize("action_scale", ["linear", "root"])
def test_the_actions_of_a_demonstration_are_executed_at_its_own_steps(horizons, action_scale):
    policy, data = recites(**horizons, action_scale=action_scale)
    count, first = policy.config.action_horizon, policy.config.obs_horizon - 1
    observations, actions = data.sample(torch.arange(len(data)))
    executed = policy.sample(observations, 1, generators(len(data)))
    torch.testing.assert_close(executed, actions[:, first : first + count], rtol=0, atol=1e-5)

    def ask(request: PolicyRequest) -> np.ndarray:
        batch = {key: torch.as_tensor(values)[None] for key, values in request.observation.items()}
        return policy.sample(batch, 1, generators(1))[0].numpy()

    episode = ActionChunks(SPEC, policy.config.obs_horizon, ask)
    acted = [episode.act(dict(extra=dict(tcp_pose=torch.as_tensor(pose_at(step))[None])))[0] for step in range(STEPS)]
    np.testing.assert_allclose(acted, np.arange(STEPS) / 100, atol=1e-5)


def test_a_prediction_is_asked_for_with_the_last_observations_the_seed_and_the_step():
    requests = []

    def ask(request: PolicyRequest) -> np.ndarray:
        requests.append(request)
        return np.array([[2.0], [0.5], [-3.0], [0.0]])

    episode = ActionChunks(SPEC, 3, ask)
    for seed in (7, 8):
        episode.begin_episode(seed)
        acted = [episode.act(dict(extra=dict(tcp_pose=pose_at(10 * seed + step)[None])))[0] for step in range(6)]
        assert acted == [1.0, 0.5, -1.0, 0.0, 1.0, 0.5]  # within their limits
    asked = [(request.seed, request.step, request.observation[POSE][:, 0].tolist()) for request in requests]
    assert asked == [(7, 0, [70, 70, 70]), (7, 4, [72, 73, 74]), (8, 0, [80, 80, 80]), (8, 4, [82, 83, 84])]
    episode.reset()
    episode.act(dict(extra=dict(tcp_pose=pose_at(0)[None])))
    assert (requests[-1].seed, requests[-1].step) == (0, 0)


def test_a_force_field_of_another_sensor_is_refused():
    spec = observation_spec("tacff", (), ("right",), 16)
    episode = ActionChunks(spec, 1, lambda request: np.zeros((1, 6)))
    touch = dict(tactile_right=dict(force_field=np.zeros((1, 7, 9, 3), np.float32)))
    with pytest.raises(InvalidArgumentError, match=r"force_field has \(7, 9\) rows and columns of taxels.* from \(10, 14\)"):
        episode.act(dict(extra=dict(tcp_pose=pose_at(0)[None]), sensor_data=touch))


def test_the_first_request_of_a_policy_with_few_steps_is_answered(tmp_path):
    """Its network is tried out before it is traced, with no more steps than it has."""
    agent = load_policy(save_tiny_checkpoint(tmp_path / "1", diffusion_steps=2))
    field = np.zeros((2, 10, 14, 3), np.float32)
    request = PolicyRequest(0, 0, {POSE: np.zeros((2, 7), np.float32), "sensor_data/tactile_right/force_field": field})
    first, second = (agent.answer([request])[0] for _ in range(2))
    assert np.isfinite(first).all()
    np.testing.assert_allclose(second, first, atol=1e-4)


def test_a_policy_looks_at_the_observations_that_a_prediction_needs_and_at_no_others():
    """A prediction at the second or third step has the observations so far, the first of them repeated before its time."""
    for executed, looks in ((1, [True] * 6), (4, [True, False, True, True, True, False])):
        windows = []

        def ask(request: PolicyRequest, windows=windows, executed=executed) -> np.ndarray:
            windows.append(request.observation[POSE][:, 0].tolist())
            return np.zeros((executed, 1))

        episode, looked = ActionChunks(SPEC, 3, ask), []
        for step in range(6):
            looked.append(episode.looks)
            episode.act(dict(extra=dict(tcp_pose=pose_at(step)[None])))
        assert looked == looks
        assert windows == [[max(step - back, 0) for back in (2, 1, 0)] for step in range(0, 6, executed)]


@pytest.mark.parametrize(("lowest", "highest"), [(-3.0, -2.0), (0.5, 1.0)])
def test_actions_have_the_range_of_the_demonstrations_which_goes_beyond_1_for_joint_angles(tmp_path, lowest, highest):
    checkpoint = save_tiny_checkpoint(tmp_path / "checkpoint")
    fitted = {f"action_normalizer.{end}": torch.full((6,), value) for end, value in (("low", lowest), ("high", highest))}
    write_tensors(checkpoint / WEIGHTS, read_tensors(checkpoint / WEIGHTS) | fitted)
    policy = diffusion.SPEC.load(checkpoint)
    touch = dict(tactile_right=dict(force_field=torch.zeros(1, 10, 14, 3)))
    action = policy.act(dict(sensor_data=touch, extra=dict(tcp_pose=torch.as_tensor(pose_at(0))[None])))
    assert action.min() >= lowest - 1e-5
    assert action.max() <= highest + 1e-5
    assert np.ptp(action) > 0


class Learns(Recites):
    """Keeps the pairs of actions and conditions from which it would learn."""

    name = "learns"

    def make_networks(self):
        return TakesPose(), torch.nn.Identity()

    def generation_loss(self, clean, condition):
        self.pairs = clean, condition
        return clean.mean()

    def generate(self, condition, steps, generators):
        return condition[:, -1:, :1].expand(-1, self.config.pred_horizon, 1)


class TakesPose(torch.nn.Module):
    """An encoder whose features (B, obs_horizon, 7) are the normalised poses."""

    def forward(self, obs):
        return obs[POSE]


def test_every_draw_of_noise_keeps_an_observation_with_its_own_actions():
    policy, data = Learns(PolicyConfig(noise_draws=3), SPEC, 1), recites()[1]
    policy.fit_normalizers(data.observations, data.actions)
    policy(*data.sample(torch.tensor([3, 11])))
    clean, condition = policy.pairs
    steps = policy.obs_normalizer(POSE).restore(condition)[:, -1, 0]
    assert steps.tolist() == pytest.approx([3, 3, 3, 11, 11, 11])
    assert (100 * policy.action_normalizer.restore(clean)[:, 1, 0]).tolist() == pytest.approx(steps.tolist(), abs=1e-3)


def test_noise_is_added_to_the_pose_in_training_alone_and_not_to_its_height():
    data = recites()[1]
    policy = Learns(PolicyConfig(pose_noise=0.5), SPEC, 1)
    policy.fit_normalizers(data.observations, data.actions)
    torch.manual_seed(0)
    observations, actions = data.sample(torch.full((2000,), 5))
    policy(observations, actions)
    clean, condition = policy.pairs
    spread = condition.std(0)
    assert spread[:, 2].max() == 0.0
    assert spread[:, [0, 1, 3, 4, 5, 6]].flatten().tolist() == pytest.approx([0.5] * 12, rel=0.1)
    assert clean.std(0).max() == 0.0
    executed = policy.sample(observations, 1, generators(2000))
    assert executed.std(0).max() == 0.0


def test_noise_is_added_to_touch_in_training_alone_and_to_no_camera():
    spec = observation_spec("rgb+tacrgb+tacff", ("wrist",), ("right",), 16, taxel_shape=(2, 3))
    (camera, pad), (field,) = spec.images, spec.force_fields
    policy, seen = Learns(PolicyConfig(touch_noise=0.5), spec, 1), []
    policy.encoder.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    white = torch.full((1000, 2, 16, 16, 3), 255, dtype=torch.uint8)
    obs = {POSE: torch.zeros(1000, 2, 7), camera: white, pad: white, field: torch.zeros(1000, 2, 2, 3, 3)}
    torch.manual_seed(0)
    policy(obs, torch.zeros(1000, 16, 1))
    (trained,) = seen
    for key, mean in ((pad, 1.0), (field, 0.0)):
        spread = trained[key].std(0).flatten()
        assert spread.tolist() == pytest.approx([0.5] * len(spread), rel=0.15)
        assert trained[key].mean().item() == pytest.approx(mean, abs=0.02)
    assert torch.equal(trained[camera], white)
    assert not trained[POSE].any()
    policy.sample(obs, 1, generators(1000))
    assert torch.equal(seen[1][pad], white)
    assert not seen[1][field].any()


# ------------------------------------------------------------------ Diffusion Policy and Flow Matching


def kept_after_steps(count: int) -> torch.Tensor:
    """The share of the clean actions' variance that each of `count` diffusion steps leaves, by its closed form.

    It is the squared cosine of Nichol and Dhariwal (2021, eq. 17), of which a step takes 0.999 at most.
    """
    times = torch.arange(count + 1, dtype=torch.float64) / count
    level = torch.cos((times + 0.008) / 1.008 * torch.pi / 2) ** 2
    return (1 - (1 - level[1:] / level[:-1]).clamp(max=0.999)).cumprod(0).float()


class KnowsNoise(torch.nn.Module):
    """The best network over diffusion steps where all demonstrations are `CLEAN`."""

    def __init__(self, steps: int, prediction: str):
        super().__init__()
        self.kept, self.prediction = kept_after_steps(steps), prediction

    def forward(self, noisy, step, condition):
        kept = self.kept[step.long()].view(-1, 1, 1)
        noise = (noisy - kept.sqrt() * CLEAN) / (1 - kept).sqrt()
        return noise if self.prediction == "epsilon" else CLEAN.expand_as(noisy)


@pytest.mark.parametrize(
    ("config", "name"),
    [
        (DiffusionConfig, "diffusion_steps"),
        (FlowConfig, "segments"),
        (EquivariantConfig, "hidden"),
        (EquivariantConfig, "action_fields"),
    ],
)
def test_amounts_that_no_policy_can_have_are_refused(config, name):
    with pytest.raises(InvalidArgumentError, match=f"{name}=0 must be at least 1; give a larger number"):
        config(**{name: 0})
    with pytest.raises(InvalidArgumentError, match="noise_draws=0"):  # the settings of every policy are checked, too
        config(noise_draws=0)


@pytest.mark.parametrize("prediction", ["epsilon", "sample"])
@pytest.mark.parametrize(("sampler", "steps", "draws_again"), [("ddpm", 20, True), ("ddpm", 5, False), ("ddim", 20, False)])
def test_diffusion_learns_what_its_network_predicts_and_generates_the_demonstrated_actions(
    prediction, sampler, steps, draws_again
):
    config = DiffusionConfig(diffusion_steps=20, prediction=prediction, sampler=sampler, down_dims=(8,))
    policy = DiffusionPolicy(config, SPEC, 6).eval()
    policy.action_network = KnowsNoise(20, prediction)
    condition, used, fresh = torch.zeros(3, 4), generators(3), generators(3)
    assert float(policy.generation_loss(CLEAN.expand(64, -1, -1), torch.zeros(64, 4))) < 1e-6
    torch.testing.assert_close(policy.generate(condition, steps, used), CLEAN.expand(3, -1, -1), rtol=0, atol=1e-3)
    policy.noise(condition, fresh)  # DDIM draws the noise that generation starts from, and no more
    same = [torch.equal(one.get_state(), other.get_state()) for one, other in zip(used, fresh, strict=True)]
    assert same == [not draws_again] * 3


@pytest.mark.parametrize(
    "wrong", [dict(action_scale="Root"), dict(action_form="targets"), dict(sampler="DDPM"), dict(action_network="transformer")]
)
def test_choices_are_checked_as_on_the_command_line(wrong):
    ((name, value),) = wrong.items()
    with pytest.raises(InvalidArgumentError, match=f"{name}='{value}' is unknown; choose from "):
        DiffusionConfig(**wrong)


class KnowsSpread(torch.nn.Module):
    """The best network of Diffusion Policy where the demonstrated actions have a normal distribution; it predicts them."""

    def __init__(self, mean: float, spread: float, alphas: torch.Tensor):
        super().__init__()
        self.mean, self.variance, self.alphas = mean, spread**2, alphas

    def forward(self, x, step, condition):
        signal = self.alphas[step].view(-1, 1, 1)
        gain = signal.sqrt() * self.variance / (signal * self.variance + 1 - signal)
        return self.mean + gain * (x - signal.sqrt() * self.mean)


def test_few_steps_of_diffusion_generate_actions_as_they_are_distributed_and_one_step_is_refused():
    policy = DiffusionPolicy(DiffusionConfig(prediction="sample", sampler="ddim", down_dims=(8,)), SPEC, 6).eval()
    policy.action_network = KnowsSpread(0.5, 0.1, policy.ddim.alphas_cumprod)
    for steps in (4, 8, 16, 50, 100):
        actions = policy.generate(torch.zeros(200, 4), steps, generators(200))
        assert float(actions.mean()) == pytest.approx(0.5, abs=0.03), steps
        assert 0.03 < float(actions.std()) < 0.13, steps
    assert not policy.config.can_generate_in(1)
    assert policy.config.can_generate_in(2)
    assert policy.config.step_range == "at least 2 and at most 100"


class KnowsVelocity(torch.nn.Module):
    """The best network of Flow Matching where all demonstrations are `CLEAN`: straight to them, in the time that is left."""

    def __init__(self, scale: float, prediction: str):
        super().__init__()
        self.scale, self.prediction = scale, prediction

    def forward(self, x, time, condition):
        left = 1 - (time / self.scale).view(-1, 1, 1)
        return (CLEAN - x) / left.clamp(min=1e-3) if self.prediction == "velocity" else CLEAN.expand_as(x)


@pytest.mark.parametrize(
    "settings",
    [dict(), dict(public_code=True), dict(consistency=True), dict(consistency=True, segments=2), dict(prediction="sample")],
    ids=str,
)
def test_flow_matching_learns_the_straight_path_to_the_demonstrated_actions(settings):
    policy = FlowMatchingPolicy(FlowConfig(**settings, down_dims=(8,)), SPEC, 6).eval()
    policy.action_network = KnowsVelocity(1.0 if settings.get("public_code") else 100.0, policy.config.prediction)
    torch.manual_seed(0)
    assert float(policy.generation_loss(CLEAN.expand(64, -1, -1), torch.zeros(64, 4))) < 1e-3
    for steps in (1, 7):
        found = policy.generate(torch.zeros(3, 4), steps, generators(3))
        torch.testing.assert_close(found, CLEAN.expand(3, -1, -1), rtol=0, atol=1e-3)


def test_flow_matching_integrates_over_the_times_at_the_beginnings_of_its_steps():
    """The velocity t leads from noise x to x + the mean of the times k / n: (n - 1) / (2 n)."""
    policy = FlowMatchingPolicy(FlowConfig(down_dims=(8,)), SPEC, 6).eval()
    policy.action_network = TellsTime()
    policy.noise = lambda condition, generators: torch.full((1, 16, 6), -0.5)
    for steps in (1, 4):
        found = policy.generate(torch.zeros(1, 4), steps, generators(1))
        torch.testing.assert_close(found, torch.full((1, 16, 6), (steps - 1) / (2 * steps) - 0.5), rtol=0, atol=1e-6)


class TellsTime(torch.nn.Module):
    def forward(self, x, time, condition):
        return (time / 100).view(-1, 1, 1).expand_as(x)


class Says(torch.nn.Module):
    """A network that always has the same answer, and keeps the times or steps that it was asked for."""

    def __init__(self, value: float):
        super().__init__()
        self.value, self.asked = torch.nn.Parameter(torch.tensor(value)), []

    def forward(self, x, time, condition):
        self.asked.append(time)
        return self.value.expand_as(x)


@pytest.mark.parametrize("settings", [dict(), dict(sampler="ddim"), dict(prediction="sample")], ids=str)
@pytest.mark.parametrize("policy", ["diffusion", "flow"])
def test_generated_actions_stay_within_the_range_of_the_demonstrations(policy, settings):
    if policy == "diffusion":
        made: Any = DiffusionPolicy(DiffusionConfig(diffusion_steps=20, down_dims=(8,), **settings), SPEC, 6).eval()
    else:
        made = FlowMatchingPolicy(FlowConfig(down_dims=(8,), prediction=settings.get("prediction", "velocity")), SPEC, 6).eval()
    made.action_network = Says(5.0)
    with torch.no_grad():
        found = made.generate(torch.zeros(3, 4), 20, generators(3))
    assert found.abs().max() <= 1 + 1e-6


@pytest.mark.parametrize(
    ("make", "config", "most"), [(DiffusionPolicy, DiffusionConfig, 99), (FlowMatchingPolicy, FlowConfig, 100)]
)
def test_each_row_of_a_batch_learns_at_a_step_of_its_own(make, config, most):
    policy = make(config(down_dims=(8,)), SPEC, 6)
    policy.action_network = Says(0.0)
    policy.generation_loss(CLEAN.expand(500, -1, -1), torch.zeros(500, 4))
    (times,) = policy.action_network.asked
    assert times.unique().numel() > 90
    assert 0 <= times.min() < 0.05 * most < 0.95 * most < times.max() <= most


@pytest.mark.parametrize("segments", [1, 2, 4])
def test_the_end_to_which_a_consistent_velocity_leads_is_that_of_its_segment(segments):
    """If a whole segment must agree with its end, no velocity at all misses it by the time left: 1 / (3 segments^2)."""
    policy = FlowMatchingPolicy(FlowConfig(consistency=True, segments=segments, interval=1.0, down_dims=(8,)), SPEC, 6)
    policy.action_network = Says(0.0)
    torch.manual_seed(0)
    loss = policy.generation_loss(torch.zeros(4000, 16, 6), torch.zeros(4000, 4))
    assert float(loss) == pytest.approx(1 / (3 * segments**2), rel=0.1)


def test_the_later_of_two_points_is_what_the_earlier_one_learns_from():
    """The gradient goes through the velocity at the earlier point alone: -2 dt E[clean - noise] E[time left] = -dt."""
    policy = FlowMatchingPolicy(FlowConfig(consistency=True, interval=0.01, down_dims=(8,)), SPEC, 6)
    policy.action_network = Says(0.0)
    torch.manual_seed(0)
    policy.generation_loss(torch.ones(2000, 16, 6), torch.zeros(2000, 4)).backward()
    assert float(policy.action_network.value.grad) == pytest.approx(-0.01, rel=0.1)
