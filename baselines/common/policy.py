"""The base of all policies: an observation encoder, normalisers, and the way from a prediction to actions."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal, cast

import torch
import torch.nn as nn
from tyro.conf import arg

from manifeel_ms3.arguments import require_amount, require_at_least, require_choices
from manifeel_ms3.errors import InvalidArgumentError

from .encoders import EncoderConfig, ObservationEncoder, PretrainedEncoder
from .images import scaled
from .mlp import ConditionalMLP
from .normalizer import ActionNormalizer, Normalizer
from .observation import POSE, ObservationSpec, is_tactile
from .unet import DOWN_DIMS, KERNEL_SIZE, NUM_GROUPS, STEP_EMBED_DIM, ConditionalUnet1D

LEAST_EMBED_DIM = 4
"""Smallest size of the embedding of a step: a sine and a cosine of its shortest and of its longest wave."""
HEIGHT = 2
"""Index of the height among the features of a pose."""


@dataclass
class PolicyConfig:
    """Settings of a policy; the defaults are the paper's, which are those of Diffusion Policy.

    Raises:
        InvalidArgumentError: A horizon is less than 1, a prediction has too few actions for those that are executed, or no
            network can have these sizes.
    """

    obs_horizon: Annotated[int, arg(aliases=["--obs-horizon"])] = 2
    """Number of observations, the present one included, that condition a prediction."""
    pred_horizon: Annotated[int, arg(aliases=["--pred-horizon"])] = 16
    """Number of actions in a prediction."""
    action_horizon: Annotated[int, arg(aliases=["--act-horizon"])] = 8
    """Number of actions of a prediction that are executed before the next prediction."""
    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    """Networks that encode the observations."""
    action_form: Literal["delta", "target"] = "delta"
    """Form in which actions are predicted: "delta", how far the hand moves at a step, as in the paper, or "target", the pose
    that it is to have (`baselines.common.pose_targets`). The actions that are executed are motions in both cases."""
    action_scale: Literal["linear", "root"] = "linear"
    """Scale of the actions in the loss: "linear" as in the paper, or "root", which gives more weight to the small
    actions with which parts are brought together."""
    tacrgb_scale: Literal["colour", "pixel"] = "colour"
    """Scale of TacRGB images: "colour" maps 0 to 255 to [-1, 1] as in the paper, and "pixel" the range that every pixel has in
    the demonstrations, as for force fields, because touch changes most pixels by a few grey levels. For networks that begin
    with pretrained weights it must be "colour"."""
    action_network: Literal["unet", "mlp"] = "unet"
    """Network over action sequences: the 1-D U-Net of Diffusion Policy, or a residual MLP, which takes less time on a CPU."""
    mlp_width: int = 256
    """Number of features of the MLP."""
    mlp_blocks: int = 3
    """Number of residual blocks of the MLP."""
    down_dims: tuple[int, ...] = DOWN_DIMS
    """Channels of the U-Net, from the finest to the coarsest scale."""
    kernel_size: int = KERNEL_SIZE
    """Kernel size of the U-Net's convolutions, time steps."""
    n_groups: int = NUM_GROUPS
    """Number of groups of the U-Net's GroupNorm."""
    diffusion_step_embed_dim: int = STEP_EMBED_DIM
    """Size of the embedding of the diffusion step (or of the flow's time)."""
    pose_noise: float = 0.0
    """Standard deviation of the noise that training adds to the normalised tool pose, except to its height. Without noise, a
    policy trained on a few demonstrations can recognise each of them by the pose alone; the height does not tell them apart,
    and says how far the work has come."""
    touch_noise: float = 0.0
    """Standard deviation of the noise that training adds to every value of TacRGB images and force fields, where they have the
    range [-1, 1]; docs/trials.md has a trial."""
    noise_draws: int = 1
    """Number of noise samples for each observation in a loss; more cost little where the encoder takes most of the time."""

    @property
    def predicts_targets(self) -> bool:
        """Whether the policy predicts targets instead of actions."""
        return self.action_form == "target"

    @property
    def least_inference_steps(self) -> int:
        """Smallest number of generation steps that leads to the actions that the policy has learnt."""
        return 1

    @property
    def most_inference_steps(self) -> int | None:
        """Largest number of generation steps; None if there is no limit."""
        return None

    def can_generate_in(self, steps: int) -> bool:
        """Whether the policy can generate actions in a number of steps."""
        most = self.most_inference_steps
        return self.least_inference_steps <= steps and (most is None or steps <= most)

    @property
    def step_range(self) -> str:
        """The numbers of generation steps that are possible, in words."""
        most = self.most_inference_steps
        return f"at least {self.least_inference_steps}" + ("" if most is None else f" and at most {most}")

    def __post_init__(self):
        require_choices(self)
        if self.obs_horizon < 1 or self.action_horizon < 1:
            raise InvalidArgumentError(
                f"obs_horizon={self.obs_horizon} and action_horizon={self.action_horizon} must be at least 1"
            )
        if self.pred_horizon < (least := self.obs_horizon - 1 + self.action_horizon):
            raise InvalidArgumentError(
                f"pred_horizon={self.pred_horizon} must be at least {least}: a prediction begins with the action at the "
                f"first of obs_horizon={self.obs_horizon} observations, and action_horizon={self.action_horizon} actions are "
                "executed from the last of them on; give a larger pred_horizon, or a smaller action_horizon"
            )
        require_amount("pose_noise=", self.pose_noise)
        require_amount("touch_noise=", self.touch_noise)
        require_at_least(1, noise_draws=self.noise_draws, mlp_width=self.mlp_width, mlp_blocks=self.mlp_blocks)
        if self.diffusion_step_embed_dim < LEAST_EMBED_DIM or self.diffusion_step_embed_dim % 2:
            raise InvalidArgumentError(
                f"diffusion_step_embed_dim={self.diffusion_step_embed_dim} must be an even number of at least {LEAST_EMBED_DIM}"
            )
        if self.action_network == "unet":
            self._require_unet()

    def _require_unet(self) -> None:
        """Check that a U-Net of these sizes can be built, and halves a prediction to its coarsest scale without a rest."""
        narrowest = min(self.down_dims, default=0)
        require_at_least(1, kernel_size=self.kernel_size, n_groups=self.n_groups, down_dims=narrowest)
        if self.kernel_size % 2 == 0:
            raise InvalidArgumentError(f"kernel_size={self.kernel_size} must be odd, so that a convolution keeps the length")
        if odd := [width for width in self.down_dims if width % self.n_groups]:
            raise InvalidArgumentError(f"down_dims={odd} must be multiples of n_groups={self.n_groups}")
        if self.pred_horizon % (multiple := 2 ** (len(self.down_dims) - 1)):
            raise InvalidArgumentError(
                f"pred_horizon={self.pred_horizon} must be a multiple of {multiple}, as the U-Net halves it between its "
                f"{len(self.down_dims)} scales (down_dims); the policy still executes action_horizon={self.action_horizon}"
            )


class VisuotactilePolicy(nn.Module):
    """Generates an action sequence, conditioned on a window of observations.

    Subclasses define `generation_loss` and `generate`, and can build other networks in `make_networks`.

    Args:
        config: Settings.
        spec: Observations that the policy takes.
        action_dim: Number of components of an action, A.

    Raises:
        UnknownNameError: No encoder has a configured name.
        InvalidArgumentError: An encoder does not take images of this size, or cannot be frozen.
    """

    name: ClassVar[str]
    """Name under which the policy is registered (`baselines.registry`)."""
    Config: ClassVar[type[PolicyConfig]] = PolicyConfig
    """Class of the settings."""
    control_modes: ClassVar[tuple[str, ...] | None] = None
    """Control modes whose actions the policy can learn; all of them if None."""
    config: PolicyConfig

    def __init__(self, config: PolicyConfig, spec: ObservationSpec, action_dim: int):
        super().__init__()
        self.config, self.spec, self.action_dim = config, spec, action_dim
        self.encoder, self.action_network = self.make_networks()
        normalizers = {POSE: Normalizer(spec.pose_features)}
        normalizers |= {key: Normalizer.of_taxels(spec.taxel_shape) for key in spec.force_fields}
        if config.tacrgb_scale == "pixel":
            self._require_no_pretrained()
            normalizers |= {key: Normalizer.of_pixels(spec.size_of(key)) for key in spec.images if is_tactile(key)}
        self.normalized = list(normalizers)
        self.obs_normalizers = nn.ModuleDict({module_name(key): one for key, one in normalizers.items()})
        shape = (config.pred_horizon, action_dim) if config.predicts_targets else action_dim
        self.action_normalizer = ActionNormalizer(shape, config.action_scale == "root", self.action_pairs())

    def make_networks(self) -> tuple[nn.Module, nn.Module]:
        """The observation encoder, and the network over action sequences."""
        config = self.config
        encoder = ObservationEncoder(config.encoder, self.spec, config.obs_horizon)
        return encoder, make_action_network(config, self.action_dim, encoder.out_features)

    def _require_no_pretrained(self) -> None:
        if any(isinstance(network, PretrainedEncoder) for network in self.encoder.modules()):
            raise InvalidArgumentError(
                f"tacrgb_scale='pixel': {self.config.encoder.tacrgb!r} scales its images as its authors do; leave it 'colour'"
            )

    def action_pairs(self) -> list[tuple[int, int]]:
        """Indices of the components of an action that must be scaled as the x and y of one vector; none by default."""
        return []

    def generation_loss(self, clean: torch.Tensor, condition: torch.Tensor) -> torch.Tensor:
        """The loss, a scalar, of normalised actions (B, pred_horizon, A) given conditions (B, ...)."""
        raise NotImplementedError

    def generate(self, condition: torch.Tensor, steps: int, generators: list[torch.Generator]) -> torch.Tensor:
        """Normalised actions (B, pred_horizon, A), generated in `steps` steps given conditions (B, ...) and B generators."""
        raise NotImplementedError

    def fit_normalizers(self, observations: dict[str, torch.Tensor], actions: torch.Tensor) -> None:
        """Fit the normalisers to the demonstrations.

        Args:
            observations: Observations {key: (S, ...)}.
            actions: Actions (S, A), or targets (S, pred_horizon, A), which have a range for each step of a prediction.
        """
        for key in self.normalized:
            self.obs_normalizer(key).fit(observations[key])
        self.action_normalizer.fit(actions)
        for network in self.modules():
            if isinstance(network, PretrainedEncoder):
                network.fit(observations[key] for key in self.spec.images if is_tactile(key))

    def obs_normalizer(self, key: str) -> Normalizer:
        """The normaliser of an observation."""
        return cast(Normalizer, self.obs_normalizers[module_name(key)])

    def condition(self, obs: dict[str, torch.Tensor], is_noisy: bool = False) -> torch.Tensor:
        """Features (B, ...) of observations {key: (B, obs_horizon, ...)}, with the noise of training if asked for."""
        seen = {**obs, **{key: self.obs_normalizer(key).normalize(obs[key]) for key in self.normalized}}
        return self.encoder(self._with_noise(seen) if is_noisy else seen)

    def _with_noise(self, obs: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Observations whose pose, except for the height, and whose touch have noise; those without normaliser are uint8."""
        noisy = dict(obs)
        if self.config.pose_noise > 0:
            noise = self.config.pose_noise * torch.randn_like(obs[POSE])
            noise[..., HEIGHT] = 0.0
            noisy[POSE] = obs[POSE] + noise
        if self.config.touch_noise > 0:
            for key in filter(is_tactile, (*self.spec.images, *self.spec.force_fields)):
                touch = scaled(obs[key])
                noisy[key] = touch + self.config.touch_noise * torch.randn_like(touch)
        return noisy

    def forward(self, obs: dict[str, torch.Tensor], actions: torch.Tensor) -> torch.Tensor:
        """The loss of a batch of observations {key: (B, obs_horizon, ...)} and actions (B, pred_horizon, A)."""
        draws = self.config.noise_draws
        condition = self.condition(obs, is_noisy=True).repeat_interleave(draws, dim=0)
        return self.generation_loss(self.action_normalizer.normalize(actions).repeat_interleave(draws, dim=0), condition)

    @torch.no_grad()
    def sample(self, obs: dict[str, torch.Tensor], inference_steps: int, generators: list[torch.Generator]) -> torch.Tensor:
        """The actions or targets (B, action_horizon, A) to execute next, with noise from B generators."""
        actions = self.generate(self.condition(obs), inference_steps, generators)
        first = self.config.obs_horizon - 1
        return self.action_normalizer.restore(actions)[:, first : first + self.config.action_horizon]

    def noise(self, condition: torch.Tensor, generators: list[torch.Generator]) -> torch.Tensor:
        """The noise (B, pred_horizon, A) from which generation starts."""
        return draw_rows(torch.randn, (self.config.pred_horizon, self.action_dim), generators, condition.device)


def draw_rows(
    draw: Callable[..., torch.Tensor], shape: tuple[int, ...], generators: list[torch.Generator], device: torch.device
) -> torch.Tensor:
    """Random numbers (B, *shape), with a generator for each row, so that a row does not depend on those beside it.

    Args:
        draw: `torch.randn` or `torch.rand`.
        shape: Shape of a row.
        generators: One generator on the CPU for each row.
        device: Device of the result.
    """
    return torch.stack([draw(shape, generator=generator) for generator in generators]).to(device)


def make_action_network(config: PolicyConfig, action_dim: int, condition_dim: int) -> nn.Module:
    """The network over action sequences that a policy's settings ask for.

    Args:
        config: Settings of the policy.
        action_dim: Number of components of an action.
        condition_dim: Number of features of a condition.
    """
    embedding = config.diffusion_step_embed_dim
    if config.action_network == "mlp":
        return ConditionalMLP(action_dim, condition_dim, config.pred_horizon, config.mlp_width, config.mlp_blocks, embedding)
    return ConditionalUnet1D(action_dim, condition_dim, config.down_dims, config.kernel_size, config.n_groups, embedding)


def module_name(key: str) -> str:
    """The name of a module that belongs to an observation; the slashes of the key become underscores."""
    return key.replace("/", "_")
