"""Encoder and denoiser of the equivariant policy: if the scene turns about the vertical axis, their outputs turn with it."""

import torch
import torch.nn as nn

from baselines.common.encoders import EncoderConfig, by_name, field_encoder, image_encoder
from baselines.common.images import network_images
from baselines.common.observation import POSE, ObservationSpec, is_tactile
from manifeel_ms3.agents.panda_gelsight import ACTION_AXES
from manifeel_ms3.errors import InvalidArgumentError

from .groups import ORDER, GroupConv, from_regular, representation, to_regular, turned
from .image_encoders import EQUIVARIANT_IMAGE_ENCODERS

POSE_PAIRS = ((0, 1), (3, 4), (6, 7))
"""Indices of x and y, which turn, in the position and the two columns of the rotation matrix that encode a pose."""


def _turning(axes: tuple[str, ...]) -> tuple[tuple[int, int], ...]:
    """Indices of the pairs that turn as vectors do, among the named components of an action."""
    return tuple((axes.index(x), axes.index(y)) for x, y in (("x", "y"), ("roll", "pitch")) if x in axes)


ACTION_PAIRS = {len(axes): _turning(axes) for axes in ACTION_AXES.values()}
"""Indices of x and y, which turn, in the positions and rotation vectors of actions, by the size of an action; all control modes
of `ACTION_AXES` whose actions have the same size have the same."""
HAND_CAMERAS = ("sensor_data/wrist/rgb",)
"""Images of cameras that the hand carries."""


class EquivariantObservationEncoder(nn.Module):
    """Features (B, 8, obs_horizon * fields) of a window of observations in every frame.

    Camera images and the tool pose turn with the scene. The image of a camera on the hand stays as it is when the hand turns
    with the scene, so its features are turned by the hand's yaw. A tactile sensor turns with the hand that carries it, so its
    observations are the same in every frame; their encoders are those of all policies.

    Args:
        config: Names of the networks.
        spec: Observations of the policy.
        fields: Number of regular fields of the features.
        obs_horizon: Number of time steps in a window.

    Raises:
        InvalidArgumentError: The policy cannot rotate poses in this form.
        UnknownNameError: No network has a configured name.
    """

    turns: torch.Tensor

    def __init__(self, config: EncoderConfig, spec: ObservationSpec, fields: int, obs_horizon: int):
        super().__init__()
        if spec.pose != "rotation_6d":
            raise InvalidArgumentError(f"pose={spec.pose!r}: this policy rotates poses as vectors; give --pose rotation_6d")
        self.config, self.spec = config, spec
        self.cameras = [key for key in spec.images if not is_tactile(key)]
        self.pads = [key for key in spec.images if is_tactile(key)]
        view = by_name(EQUIVARIANT_IMAGE_ENCODERS, config.image)
        self.views = nn.ModuleList(view(fields) for _ in self.cameras)
        self.images = nn.ModuleList(image_encoder(config, spec, key) for key in self.pads)
        self.fields = nn.ModuleList(field_encoder(config, spec) for _ in spec.force_fields)
        touch = config.tactile_features * (len(self.images) + len(self.fields))
        self.from_pose = nn.Linear(spec.pose_features, fields)
        self.from_views = GroupConv(fields * len(self.views), fields, 1) if self.views else None
        self.from_touch = nn.Linear(touch, fields, bias=False) if touch else None
        self.out_features = obs_horizon * fields
        self.register_buffer("turns", representation(spec.pose_features, POSE_PAIRS), persistent=False)

    def forward(self, obs: dict[str, torch.Tensor]) -> torch.Tensor:
        """Encode observations {key: (B, obs_horizon, ...)}: images as uint8, the rest as normalised floats."""
        batch, horizon = obs[POSE].shape[:2]
        pose = obs[POSE].flatten(0, 1)
        features = self.from_pose(to_regular(pose, self.turns))  # (8, B * obs_horizon, fields)
        if self.from_views is not None:
            views = torch.cat([self._view(key, obs, pose) for key in self.cameras], dim=1)
            mixed = self.from_views(views.flatten(1)[..., None, None])
            features = features + mixed.view(len(pose), -1, ORDER).movedim(2, 0)
        if self.from_touch is not None:
            features = features + self.from_touch(self._touch(obs))
        return features.view(ORDER, batch, horizon, -1).flatten(2).movedim(0, 1)

    def _view(self, key: str, obs: dict[str, torch.Tensor], pose: torch.Tensor) -> torch.Tensor:
        """Features (B * obs_horizon, fields, 8) of a camera, in the frame of the scene."""
        fields = self.views[self.cameras.index(key)](network_images(obs[key], self.config.crop_of(key), self.training))
        if key not in HAND_CAMERAS:
            return fields
        x, y = POSE_PAIRS[1]  # the hand's own x axis, which is level where the hand points down
        return turned(fields, torch.atan2(pose[:, y], pose[:, x]))

    def _touch(self, obs: dict[str, torch.Tensor]) -> torch.Tensor:
        """Features (B * obs_horizon, F) of all tactile observations."""
        crop = self.config.tactile_crop
        images = [net(network_images(obs[key], crop, self.training)) for key, net in zip(self.pads, self.images, strict=True)]
        fields = [
            net(obs[key].flatten(0, 1).movedim(-1, 1)) for key, net in zip(self.spec.force_fields, self.fields, strict=True)
        ]
        return torch.cat([*images, *fields], dim=-1)


class EquivariantActionNetwork(nn.Module):
    """One network predicts in every frame from the actions and condition in that frame; the output is the mean of all frames.

    The network sees actions as regular fields, and what it predicts is turned back into actions.

    Args:
        action_dim: Number of components of an action.
        fields: Number of regular fields for an action.
        network: Network from fields (B, T, fields), steps (B,) and the condition in a frame (B, C) to fields (B, T, fields).

    Raises:
        InvalidArgumentError: `ACTION_PAIRS` does not say how actions of this size rotate.
    """

    turns: torch.Tensor

    def __init__(self, action_dim: int, fields: int, network: nn.Module):
        super().__init__()
        if action_dim not in ACTION_PAIRS:
            raise InvalidArgumentError(
                f"action_dim={action_dim}: this policy rotates actions of {sorted(ACTION_PAIRS)} numbers only (ACTION_PAIRS); "
                f"record them in one of the control modes {list(ACTION_AXES)}"
            )
        self.embed = nn.Sequential(nn.Linear(action_dim, fields), nn.ReLU())
        self.network = network
        self.out = nn.Linear(fields, action_dim)
        self.register_buffer("turns", representation(action_dim, ACTION_PAIRS[action_dim]), persistent=False)

    def forward(self, actions: torch.Tensor, step: torch.Tensor, condition: torch.Tensor) -> torch.Tensor:
        """The prediction (B, T, A) for actions (B, T, A) at steps (B,), given conditions (B, 8, C)."""
        regular = self.embed(to_regular(actions, self.turns)).flatten(0, 1)
        predicted = self.out(self.network(regular, step.repeat(ORDER), condition.movedim(1, 0).flatten(0, 1)))
        return from_regular(predicted.view(ORDER, *actions.shape), self.turns)
