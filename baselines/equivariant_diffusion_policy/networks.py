"""Encoder and denoiser of the equivariant policy: if the scene turns about the vertical axis, their outputs turn with it."""

from itertools import pairwise
from typing import Any

import torch
import torch.nn as nn

from baselines.common.encoders import IMAGE_FEATURES, EncoderConfig, cropped, field_encoder, image_encoder, network_images
from baselines.common.observation import POSE, POSE_FEATURES, ObservationSpec, is_tactile
from baselines.common.unet import ConditionalUnet1D
from manifeel_ms3.errors import InvalidArgumentError

from .groups import ORDER, FieldNorm, GroupConv, from_regular, halve, representation, to_regular

POSE_PAIRS = ((0, 1), (3, 4), (6, 7))
"""Indices of x and y, which turn, in the position and the two columns of the rotation matrix that encode a pose."""
ACTION_PAIRS = {
    5: ((0, 1),),  # position, rotation about the vertical axis, gripper
    6: ((0, 1), (3, 4)),  # position, rotation vector
    7: ((0, 1), (3, 4)),  # position, rotation vector, gripper
}
"""Indices of x and y, which turn, in the positions and rotation vectors of actions, by the number of an action's numbers."""
CHANNELS_PER_GROUP = 16
"""Channels that the blocks normalise together."""
XY = representation(2, ((0, 1),))


class GroupBlock(nn.Module):
    """Two convolutions of regular fields with a skip connection."""

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        groups = max(outputs // CHANNELS_PER_GROUP, 1)
        self.net = nn.Sequential(
            GroupConv(inputs, outputs, 3),
            FieldNorm(groups, outputs),
            nn.ReLU(),
            GroupConv(outputs, outputs, 3),
            FieldNorm(groups, outputs),
        )
        self.skip = GroupConv(inputs, outputs, 1)

    def forward(self, fields: torch.Tensor) -> torch.Tensor:
        return (self.net(fields) + self.skip(fields)).relu()


class EquivariantImageEncoder(nn.Module):
    """Key points of an image (B, 3, H, W) in every frame: (8, B, 64).

    In each frame, 32 heat maps give their expected coordinates (`SpatialSoftmax`) along the frame's axes.

    Args:
        hidden: Number of regular channels of the last block.
    """

    axes: torch.Tensor

    def __init__(self, hidden: int):
        super().__init__()
        widths = [max(hidden // k, 1) for k in (8, 4, 2, 1)]
        self.lift = nn.Sequential(GroupConv(3, widths[0], 5, lifting=True), FieldNorm(1, widths[0]), nn.ReLU())
        self.blocks = nn.ModuleList(GroupBlock(i, o) for i, o in pairwise(widths))
        self.score = GroupConv(hidden, IMAGE_FEATURES // 2, 1)
        self.register_buffer("axes", XY, persistent=False)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        fields = self.lift(halve(image))
        for k, block in enumerate(self.blocks):
            fields = block(halve(fields) if k < 2 else fields)  # an eighth of the image's size at the end
        right = torch.linspace(-1, 1, fields.shape[3], device=image.device)
        up = torch.linspace(1, -1, fields.shape[2], device=image.device)
        outside = torch.hypot(right, up[:, None]) > 1  # turns leave the inscribed circle unchanged
        heat = self.score(fields).masked_fill(outside, -torch.inf)
        weight = heat.flatten(2).softmax(-1).view(len(image), -1, ORDER, *fields.shape[2:])
        place = torch.stack([(weight.sum(3) * right).sum(-1), (weight.sum(4) * up).sum(-1)], dim=-1)  # (B, 32, 8, 2)
        return torch.einsum("gba,ncgb->gnca", self.axes, place).flatten(2)


class EquivariantObservationEncoder(nn.Module):
    """Features (B, 8, obs_horizon * F) of a window of observations in every frame.

    Camera images and the tool pose turn with the scene. A tactile sensor turns with the hand that carries it, so its
    observations are the same in every frame; their encoders are those of all policies.

    Args:
        config: Names of the networks.
        spec: Observations of the policy.
        hidden: Number of regular channels of the camera encoders.
        obs_horizon: Number of time steps in a window.
    """

    turns: torch.Tensor

    def __init__(self, config: EncoderConfig, spec: ObservationSpec, hidden: int, obs_horizon: int):
        super().__init__()
        self.crop, self.spec = config.crop, spec
        self.cameras = [key for key in spec.images if not is_tactile(key)]
        self.pads = [key for key in spec.images if is_tactile(key)]
        self.views = nn.ModuleList(EquivariantImageEncoder(hidden) for _ in self.cameras)
        self.images = nn.ModuleList(image_encoder(config, spec, key) for key in self.pads)
        self.fields = nn.ModuleList(field_encoder(config, spec) for _ in spec.force_fields)
        sensors = len(self.views) + len(self.images) + len(self.fields)
        self.out_features = obs_horizon * (IMAGE_FEATURES * sensors + POSE_FEATURES)
        self.register_buffer("turns", representation(POSE_FEATURES, POSE_PAIRS), persistent=False)

    def forward(self, obs: dict[str, torch.Tensor]) -> torch.Tensor:
        """Encode observations {key: (B, obs_horizon, ...)}: images as uint8, the rest as normalised floats."""
        batch, horizon = obs[POSE].shape[:2]

        def image(key: str) -> torch.Tensor:
            return network_images(cropped(obs[key], self.crop, self.training))

        turning = [to_regular(obs[POSE].flatten(0, 1), self.turns)]
        turning += [net(image(key)) for key, net in zip(self.cameras, self.views, strict=True)]
        still = [net(image(key)) for key, net in zip(self.pads, self.images, strict=True)]
        still += [
            net(obs[key].flatten(0, 1).movedim(-1, 1)) for key, net in zip(self.spec.force_fields, self.fields, strict=True)
        ]
        features = torch.cat([*turning, *(values.expand(ORDER, *values.shape) for values in still)], dim=-1)
        return features.view(ORDER, batch, horizon, -1).flatten(2).movedim(0, 1)


class EquivariantUnet(nn.Module):
    """One U-Net predicts in every frame from the actions and the condition in that frame; the output is the mean of all frames.

    Args:
        action_dim: Numbers of an action.
        condition_dim: Numbers of the condition in a frame.
        **unet: Further arguments of `ConditionalUnet1D`.

    Raises:
        InvalidArgumentError: It is not known how actions of so many numbers turn.
    """

    turns: torch.Tensor

    def __init__(self, action_dim: int, condition_dim: int, **unet: Any):
        super().__init__()
        if action_dim not in ACTION_PAIRS:
            raise InvalidArgumentError(
                f"action_dim={action_dim}: it is only known how actions of {sorted(ACTION_PAIRS)} numbers turn; add yours to "
                "ACTION_PAIRS"
            )
        self.unet = ConditionalUnet1D(action_dim, condition_dim, **unet)
        self.register_buffer("turns", representation(action_dim, ACTION_PAIRS[action_dim]), persistent=False)

    def forward(self, actions: torch.Tensor, step: torch.Tensor, condition: torch.Tensor) -> torch.Tensor:
        """The prediction (B, T, A) for actions (B, T, A) at steps (B,), given conditions (B, 8, C)."""
        regular = to_regular(actions, self.turns).flatten(0, 1)
        predicted = self.unet(regular, step.repeat(ORDER), condition.movedim(1, 0).flatten(0, 1))
        return from_regular(predicted.view(ORDER, *actions.shape), self.turns)
