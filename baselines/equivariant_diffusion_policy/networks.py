"""Encoder and denoiser of an equivariant policy: when the scene turns about the vertical, what they say turns with it."""

import torch
import torch.nn as nn

from baselines.common.encoders import IMAGE_FEATURES, EncoderConfig, cropped, field_encoder, image_encoder
from baselines.common.observation import POSE, POSE_FEATURES, ObservationSpec, is_tactile
from baselines.common.unet import ConditionalUnet1D

from .groups import ORDER, FieldNorm, GroupConv, from_every_frame, halve, in_every_frame, representation

POSE_PAIRS = ((0, 1), (3, 4), (6, 7))  # position, and the rotation matrix's first two columns: x and y turn, z does not
ACTION_PAIRS = {  # of positions and rotation vectors, by the number of actions; 5: turning about the vertical alone
    5: ((0, 1),),
    6: ((0, 1), (3, 4)),
    7: ((0, 1), (3, 4)),
}
XY = representation(2, ((0, 1),))


class GroupBlock(nn.Module):
    """Two convolutions of regular fields with a skip."""

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        self.net = nn.Sequential(
            GroupConv(inputs, outputs, 3),
            FieldNorm(max(outputs // 16, 1), outputs),
            nn.ReLU(),
            GroupConv(outputs, outputs, 3),
            FieldNorm(max(outputs // 16, 1), outputs),
        )
        self.skip = GroupConv(inputs, outputs, 1)

    def forward(self, fields: torch.Tensor) -> torch.Tensor:
        return (self.net(fields) + self.skip(fields)).relu()


class EquivariantImageEncoder(nn.Module):
    """Key points of a picture (B, 3, H, W) as every frame sees them: (8, B, 64).

    Each of 32 heat maps per frame gives its expected place (`SpatialSoftmax`), in that frame's axes.
    """

    axes: torch.Tensor

    def __init__(self, hidden: int):
        super().__init__()
        widths = [max(hidden // k, 1) for k in (8, 4, 2, 1)]
        self.lift = nn.Sequential(GroupConv(3, widths[0], 5, lifting=True), FieldNorm(1, widths[0]), nn.ReLU())
        self.blocks = nn.ModuleList(GroupBlock(i, o) for i, o in zip(widths, widths[1:], strict=False))
        self.score = GroupConv(hidden, IMAGE_FEATURES // 2, 1)
        self.register_buffer("axes", XY, persistent=False)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        fields = self.lift(halve(image))
        for k, block in enumerate(self.blocks):
            fields = block(halve(fields) if k < 2 else fields)  # an eighth of the picture's size, at the end
        right = torch.linspace(-1, 1, fields.shape[3], device=image.device)
        up = torch.linspace(1, -1, fields.shape[2], device=image.device)
        heat = self.score(fields).masked_fill(
            torch.hypot(right, up[:, None]) > 1, -torch.inf
        )  # a turn does not move the circle
        weight = heat.flatten(2).softmax(-1).view(len(image), -1, ORDER, *fields.shape[2:])
        place = torch.stack([(weight.sum(3) * right).sum(-1), (weight.sum(4) * up).sum(-1)], dim=-1)  # (B, 32, 8, 2)
        return torch.einsum("gba,ncgb->gnca", self.axes, place).flatten(2)


class EquivariantObservationEncoder(nn.Module):
    """Features (B, 8, obs_horizon * F) of a window of observations, as every frame sees them.

    Cameras turn with the scene, and so does the tool's pose. A pad turns with the hand that it is on: what it feels is the same
    from every frame, and goes through the encoders that all policies use.
    """

    turns: torch.Tensor

    def __init__(self, config: EncoderConfig, spec: ObservationSpec, hidden: int, obs_horizon: int):
        super().__init__()
        self.crop, self.spec = config.crop, spec
        self.cameras = [key for key in spec.images if not is_tactile(key)]
        self.pads = [key for key in spec.images if is_tactile(key)]
        self.views = nn.ModuleList(EquivariantImageEncoder(hidden) for _ in self.cameras)
        self.images = nn.ModuleList(image_encoder(config, spec, key) for key in self.pads)
        self.fields = nn.ModuleList(field_encoder(config) for _ in spec.force_fields)
        sensors = len(self.views) + len(self.images) + len(self.fields)
        self.out_features = obs_horizon * (IMAGE_FEATURES * sensors + POSE_FEATURES)
        self.register_buffer("turns", representation(POSE_FEATURES, POSE_PAIRS), persistent=False)

    def forward(self, obs: dict[str, torch.Tensor]) -> torch.Tensor:
        """`obs`: {key: (B, obs_horizon, ...)}: images uint8, the rest normalised floats."""
        batch, horizon = obs[POSE].shape[:2]

        def picture(key: str) -> torch.Tensor:
            shown = cropped(obs[key], self.crop, self.training)
            return shown.flatten(0, 1).movedim(-1, 1).float() / 127.5 - 1.0

        turning = [in_every_frame(obs[POSE].flatten(0, 1), self.turns)]
        turning += [net(picture(key)) for key, net in zip(self.cameras, self.views, strict=True)]
        still = [net(picture(key)) for key, net in zip(self.pads, self.images, strict=True)]
        still += [
            net(obs[key].flatten(0, 1).movedim(-1, 1)) for key, net in zip(self.spec.force_fields, self.fields, strict=True)
        ]
        features = torch.cat([*turning, *(values.expand(ORDER, *values.shape) for values in still)], dim=-1)
        return features.view(ORDER, batch, horizon, -1).flatten(2).movedim(0, 1)


class EquivariantUnet(nn.Module):
    """One U-Net says in every frame what it makes of the actions and the condition there; the answer is the mean of all."""

    turns: torch.Tensor

    def __init__(self, action_dim: int, *args):
        super().__init__()
        if action_dim not in ACTION_PAIRS:
            raise ValueError(f"{action_dim} actions: it is known how {sorted(ACTION_PAIRS)} turn; add yours to ACTION_PAIRS")
        self.unet = ConditionalUnet1D(action_dim, *args)
        self.register_buffer("turns", representation(action_dim, ACTION_PAIRS[action_dim]), persistent=False)

    def forward(self, actions: torch.Tensor, step: torch.Tensor, condition: torch.Tensor) -> torch.Tensor:
        """(B, T, A), at steps (B,), under conditions (B, 8, C)."""
        seen = in_every_frame(actions, self.turns).flatten(0, 1)
        said = self.unet(seen, step.repeat(ORDER), condition.movedim(1, 0).flatten(0, 1))
        return from_every_frame(said.view(ORDER, *actions.shape), self.turns)
