"""The four networks as their authors define them, in single tensor operations; writes expected.json (see README.md)."""

import json
import math
from pathlib import Path

import numpy as np
import torch

from .stand_ins import HEADS, WIDTHS, picture, values

Weights = dict[str, torch.Tensor]
EXPECTED = Path(__file__).parent / "expected.json"
PROBES = 16
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
UNTOUCHED_COLOUR = (127, 134, 110)


def double(weights: Weights, prefix: str = "") -> Weights:
    """The weights under a prefix, in double precision."""
    return {name.removeprefix(prefix): tensor.double() for name, tensor in weights.items() if name.startswith(prefix)}


def layer_norm(x: torch.Tensor, w: Weights, name: str, eps: float) -> torch.Tensor:
    centred = x - x.mean(-1, keepdim=True)
    scale = (centred.square().mean(-1, keepdim=True) + eps).sqrt()
    return centred / scale * w[f"{name}.weight"] + w[f"{name}.bias"]


def linear(x: torch.Tensor, w: Weights, name: str) -> torch.Tensor:
    out = x @ w[f"{name}.weight"].T
    return out + w[f"{name}.bias"] if f"{name}.bias" in w else out


def gelu(x: torch.Tensor) -> torch.Tensor:
    return 0.5 * x * (1 + torch.erf(x / math.sqrt(2)))


def attend(q: torch.Tensor, k: torch.Tensor, v: torch.Tensor, heads: int) -> torch.Tensor:
    """Attention over tokens (N, D)."""
    parts = [part.reshape(len(part), heads, -1).movedim(1, 0) for part in (q, k, v)]
    scores = parts[0] @ parts[1].transpose(1, 2) / math.sqrt(parts[0].shape[-1])
    return (scores.softmax(-1) @ parts[2]).movedim(0, 1).reshape(len(q), -1)


def patches(image: torch.Tensor, patch: int) -> torch.Tensor:
    """Patches (N, C * patch * patch) of an image (C, H, W), row by row, each ordered as a convolution's weight."""
    channels, rows, columns = image.shape
    grid = image.reshape(channels, rows // patch, patch, columns // patch, patch).permute(1, 3, 0, 2, 4)
    return grid.reshape(-1, channels * patch * patch)


def embed(image: torch.Tensor, w: Weights, patch: int) -> torch.Tensor:
    return patches(image, patch) @ w["patch_embed.proj.weight"].flatten(1).T + w["patch_embed.proj.bias"]


def timm_block(x: torch.Tensor, w: Weights, name: str, eps: float) -> torch.Tensor:
    scales = [w.get(f"{name}.ls{k}.gamma", torch.ones(())) for k in (1, 2)]
    q, k, v = linear(layer_norm(x, w, f"{name}.norm1", eps), w, f"{name}.attn.qkv").chunk(3, dim=-1)
    x = x + scales[0] * linear(attend(q, k, v, HEADS), w, f"{name}.attn.proj")
    hidden = gelu(linear(layer_norm(x, w, f"{name}.norm2", eps), w, f"{name}.mlp.fc1"))
    return x + scales[1] * linear(hidden, w, f"{name}.mlp.fc2")


def t3(encoder: Weights, trunk: Weights, image: np.ndarray, mean: np.ndarray, std: np.ndarray) -> torch.Tensor:
    x = embed(torch.as_tensor((image / 255 - mean) / std).movedim(-1, 0), encoder, 16)
    x = torch.cat([encoder["cls_token"][0], x]) + encoder["pos_embed"][0]
    x = timm_block(x, encoder, "blocks.0", 1e-6)
    for i in range(2):
        x = timm_block(x, trunk, f"blocks.{i}", 1e-5)
    return layer_norm(x, trunk, "norm", 1e-5)[0]


def sparsh(w: Weights, image: np.ndarray, untouched: np.ndarray) -> torch.Tensor:
    difference = (image.astype(np.int32) - untouched.astype(np.int32)) / 255 + 0.5
    levels = (np.clip(difference, 0, 1) * 255).astype(np.uint8)
    upright = torch.as_tensor(np.rot90(levels, -1).copy()).movedim(-1, 0).double() / 255
    x = embed(torch.cat([upright, upright]), w, 16)
    rows, columns = upright.shape[1] // 16, upright.shape[2] // 16
    bands = w["pos_embed.frequency_bands"]
    phases = [(i * bands[0], j * bands[1]) for i in range(rows) for j in range(columns)]
    waves = [torch.cat([row.sin(), row.cos(), column.sin(), column.cos()]) for row, column in phases]
    x = torch.cat([w["register_tokens"][0], x + torch.stack(waves)])
    for i in range(2):
        x = timm_block(x, w, f"blocks.{i}", 1e-6)
    return layer_norm(x, w, "norm", 1e-6)[1:].mean(0)


def anytouch(w: Weights, image: np.ndarray, sensor: int) -> torch.Tensor:
    frame = torch.as_tensor((image / 255 - IMAGENET_MEAN) / IMAGENET_STD).movedim(-1, 0)  # (colour, H, W)
    video = torch.stack([frame] * 3)  # (frame, colour, H, W): the convolution's channels, depth, height and width
    x = patches(video.flatten(0, 1), 14) @ w["video_patch_embedding.weight"].flatten(1).T
    places = w["touch_model.embeddings.position_embedding.weight"]
    first = w["touch_model.embeddings.class_embedding"] + places[0]
    x = torch.cat([first[None], w["sensor_token"][sensor], x + places[1:]])
    x = layer_norm(x, w, "touch_model.pre_layrnorm", 1e-5)
    for i in range(2):
        layer = f"touch_model.encoder.layers.{i}"
        normed = layer_norm(x, w, f"{layer}.layer_norm1", 1e-5)
        q, k, v = (linear(normed, w, f"{layer}.self_attn.{part}_proj") for part in "qkv")
        x = x + linear(attend(q, k, v, HEADS), w, f"{layer}.self_attn.out_proj")
        hidden = gelu(linear(layer_norm(x, w, f"{layer}.layer_norm2", 1e-5), w, f"{layer}.mlp.fc1"))
        x = x + linear(hidden, w, f"{layer}.mlp.fc2")
    return linear(layer_norm(x[0], w, "touch_model.post_layernorm", 1e-5), w, "touch_projection")


def convolve(x: torch.Tensor, w: Weights, name: str, stride: int = 1) -> torch.Tensor:
    """A convolution of an image (C, H, W) as a sum over the places of its kernel; with stride 2 padded right and below only."""
    weight = w[f"{name}.weight"]
    reach = weight.shape[-1] // 2
    before, after = (reach, reach) if stride == 1 else (0, 1)
    padded = torch.nn.functional.pad(x, (before, after, before, after))
    rows, columns = (x.shape[1] // stride, x.shape[2] // stride)
    out = w[f"{name}.bias"][:, None, None].expand(-1, rows, columns)
    for i in range(weight.shape[2]):
        for j in range(weight.shape[3]):
            part = padded[:, i : i + stride * rows : stride, j : j + stride * columns : stride]
            out = out + torch.einsum("oc,chw->ohw", weight[:, :, i, j], part)
    return out


def group_norm(x: torch.Tensor, w: Weights, name: str) -> torch.Tensor:
    groups = x.reshape(32, -1)
    centred = groups - groups.mean(1, keepdim=True)
    normed = (centred / (centred.square().mean(1, keepdim=True) + 1e-6).sqrt()).reshape(x.shape)
    return normed * w[f"{name}.weight"][:, None, None] + w[f"{name}.bias"][:, None, None]


def swish(x: torch.Tensor) -> torch.Tensor:
    return x / (1 + torch.exp(-x))


def taming_block(x: torch.Tensor, w: Weights, name: str) -> torch.Tensor:
    hidden = convolve(swish(group_norm(x, w, f"{name}.norm1")), w, f"{name}.conv1")
    hidden = convolve(swish(group_norm(hidden, w, f"{name}.norm2")), w, f"{name}.conv2")
    return hidden + (convolve(x, w, f"{name}.nin_shortcut") if f"{name}.nin_shortcut.weight" in w else x)


def taming_attention(x: torch.Tensor, w: Weights, name: str) -> torch.Tensor:
    normed = group_norm(x, w, f"{name}.norm")
    q, k, v = (convolve(normed, w, f"{name}.{part}").flatten(1).T for part in "qkv")
    return x + convolve(attend(q, k, v, 1).T.reshape(x.shape), w, f"{name}.proj_out")


def unit(w: Weights, image: np.ndarray) -> torch.Tensor:
    """Latents (3, H / 8, W / 8) before their quantisation, of pictures in [0, 1]."""
    x = convolve(torch.as_tensor(image / 255).movedim(-1, 0), w, "encoder.conv_in")
    for i in range(len(WIDTHS)):
        for j in range(2):
            x = taming_block(x, w, f"encoder.down.{i}.block.{j}")
            if f"encoder.down.{i}.attn.{j}.norm.weight" in w:
                x = taming_attention(x, w, f"encoder.down.{i}.attn.{j}")
        if i + 1 < len(WIDTHS):
            x = convolve(x, w, f"encoder.down.{i}.downsample.conv", stride=2)
    x = taming_attention(taming_block(x, w, "encoder.mid.block_1"), w, "encoder.mid.attn_1")
    x = swish(group_norm(taming_block(x, w, "encoder.mid.block_2"), w, "encoder.norm_out"))
    return convolve(convolve(x, w, "encoder.conv_out"), w, "quant_conv")


def unit_head(w: Weights, latents: torch.Tensor) -> torch.Tensor:
    x = latents
    for i in (1, 2, 3):
        x = layer_norm(convolve(x, w, f"conv{i}").movedim(0, -1), w, f"ln{i}", 1e-5).movedim(-1, 0)
        x = torch.where(x > 0, x, 0.01 * x)
    x = x.flatten(1).mean(1)
    for i in (0, 3):
        x = linear(x, w, f"mlp_layers.{i}").clamp(min=0)
    return linear(x, w, "mlp_layers.6")


def probes(output: torch.Tensor) -> list[float]:
    """Evenly spaced numbers of an output, at most `PROBES`."""
    flat = output.flatten()
    return [round(float(number), 8) for number in flat[:: math.ceil(len(flat) / PROBES)]]


def expected() -> dict[str, list[float]]:
    """The outputs of all networks."""
    data = np.stack([picture(224, 224, seed=1), picture(224, 224, seed=2)])
    mean, std = (data / 255).mean((0, 1, 2)), (data / 255).std((0, 1, 2))
    touch = double(values("anytouch"), "touch_mae_model.")
    latents = unit(double(values("unit")), picture(64, 64, seed=1))
    backbone = double(values("sparsh"))
    square = np.broadcast_to(np.array(UNTOUCHED_COLOUR, np.uint8), (224, 224, 3))
    outputs = dict(
        t3=t3(double(values("t3_encoder")), double(values("t3_trunk")), data[0], mean, std),
        sparsh=sparsh(backbone, picture(240, 320, seed=1), picture(240, 320, seed=2)),
        sparsh_224=sparsh(backbone, data[0], square),
        anytouch=anytouch(touch, data[0], sensor=0),
        anytouch_digit=anytouch(touch, data[0], sensor=1),
        unit=latents,
        unit_attention=unit(double(values("unit_attention")), picture(64, 64, seed=1)),
        unit_head=unit_head(double(values("unit_head")), latents.float().double()),
    )
    return {name: probes(output) for name, output in outputs.items()}


if __name__ == "__main__":
    EXPECTED.write_text(json.dumps(expected(), indent=1) + "\n", encoding="utf-8")
