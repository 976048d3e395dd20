"""Weights under the names, in the shapes and in the nesting of the released files, with values that follow from the names.

Without arguments, the functions give the shapes of the real files; `SMALL` has those of networks that are quick to compute.
"""

import math
import zlib
from functools import partial

import numpy as np
import torch

Shapes = dict[str, tuple[int, ...]]


def linear(name: str, inputs: int, outputs: int) -> Shapes:
    return {f"{name}.weight": (outputs, inputs), f"{name}.bias": (outputs,)}


def norm(name: str, width: int) -> Shapes:
    return {f"{name}.weight": (width,), f"{name}.bias": (width,)}


def conv(name: str, inputs: int, outputs: int, size: int) -> Shapes:
    return {f"{name}.weight": (outputs, inputs, size, size), f"{name}.bias": (outputs,)}


def timm_blocks(prefix: str, count: int, width: int, scaled: bool = False) -> Shapes:
    shapes: Shapes = {}
    for i in range(count):
        block = f"{prefix}blocks.{i}"
        shapes |= norm(f"{block}.norm1", width) | norm(f"{block}.norm2", width)
        shapes |= linear(f"{block}.attn.qkv", width, 3 * width) | linear(f"{block}.attn.proj", width, width)
        shapes |= linear(f"{block}.mlp.fc1", width, 4 * width) | linear(f"{block}.mlp.fc2", 4 * width, width)
        shapes |= {f"{block}.ls{k}.gamma": (width,) for k in (1, 2)} if scaled else {}
    return shapes


def t3_encoder(width: int = 768, depth: int = 3) -> Shapes:
    """Shapes of encoders/<sensor>.pth."""
    shapes = {"cls_token": (1, 1, width), "pos_embed": (1, 197, width)}
    return shapes | conv("patch_embed.proj", 3, width, 16) | timm_blocks("", depth, width)


def t3_trunk(width: int = 768, depth: int = 9) -> Shapes:
    """Shapes of trunk.pth."""
    return timm_blocks("", depth, width) | norm("norm", width)


def sparsh(width: int = 768, depth: int = 12) -> Shapes:
    """Shapes of dino_vitbase.safetensors: 174 tensors."""
    shapes = {"register_tokens": (1, 1, width), "pos_embed.frequency_bands": (2, width // 4)}
    shapes |= conv("patch_embed.proj", 6, width, 16) | norm("norm", width)
    return shapes | timm_blocks("", depth, width, scaled=True)


def sparsh_checkpoint(width: int = 768, depth: int = 12) -> Shapes:
    """Shapes of dino_vitbase.ckpt: a student, and the teacher that is released as safetensors, both with a DINO head."""
    backbone = sparsh(width, depth)
    parts = [{f"{part}_encoder.backbone.{name}": shape for name, shape in backbone.items()} for part in ("student", "teacher")]
    return parts[0] | parts[1] | linear("teacher_encoder.dino_head.mlp.0", width, 8)


def anytouch(width: int = 1024, depth: int = 24, hidden: int = 4096, projected: int = 768, decoder: int = 512) -> Shapes:
    """Shapes of the model in checkpoint.pth: a few tensors of CLIP's text and vision models, and the touch encoder."""
    shapes = linear("text_model.encoder.layers.0.mlp.fc1", 8, 8) | {"logit_scale": ()}
    shapes |= {"vision_model.embeddings.position_embedding.weight": (257, 8), "visual_projection.weight": (8, 8)}
    mae, model = "touch_mae_model.", "touch_mae_model.touch_model."
    shapes |= {f"{mae}sensor_token": (10, 5, width), f"{mae}video_patch_embedding.weight": (width, 3, 3, 14, 14)}
    shapes |= {f"{mae}touch_projection.weight": (projected, width), f"{model}embeddings.class_embedding": (width,)}
    shapes |= {f"{model}embeddings.patch_embedding.weight": (width, 3, 14, 14)}
    shapes |= {f"{model}embeddings.position_embedding.weight": (257, width)}
    shapes |= norm(f"{model}pre_layrnorm", width) | norm(f"{model}post_layernorm", width)
    for i in range(depth):
        layer = f"{model}encoder.layers.{i}"
        shapes |= norm(f"{layer}.layer_norm1", width) | norm(f"{layer}.layer_norm2", width)
        for part in ("k_proj", "v_proj", "q_proj", "out_proj"):
            shapes |= linear(f"{layer}.self_attn.{part}", width, width)
        shapes |= linear(f"{layer}.mlp.fc1", width, hidden) | linear(f"{layer}.mlp.fc2", hidden, width)
    return shapes | _anytouch_decoder(mae, width, projected, decoder)


def _anytouch_decoder(mae: str, width: int, projected: int, decoder: int) -> Shapes:
    """Shapes that only AnyTouch's training needs: transformers' ViT layers and the layers around them."""
    shapes = {f"{mae}mask_token": (1, 1, decoder), f"{mae}sensor_token_proj.weight": (decoder, width)}
    shapes |= {f"{mae}decoder_pos_embed": (1, 257, decoder), f"{mae}video_position_embedding.weight": (257, width)}
    shapes |= linear(f"{mae}decoder_embed", projected, decoder) | norm(f"{mae}decoder_norm", decoder)
    shapes |= linear(f"{mae}decoder_pred", decoder, 588) | linear(f"{mae}decoder_pred_video", decoder, 2352)
    for i in range(8):
        layer = f"{mae}touch_decoder_blocks.{i}"
        for part in ("attention.attention.query", "attention.attention.key", "attention.attention.value"):
            shapes |= linear(f"{layer}.{part}", decoder, decoder)
        shapes |= linear(f"{layer}.attention.output.dense", decoder, decoder)
        shapes |= linear(f"{layer}.intermediate.dense", decoder, 4 * decoder)
        shapes |= linear(f"{layer}.output.dense", 4 * decoder, decoder)
        shapes |= norm(f"{layer}.layernorm_before", decoder) | norm(f"{layer}.layernorm_after", decoder)
    return shapes


def _taming_block(name: str, inputs: int, outputs: int) -> Shapes:
    shapes = norm(f"{name}.norm1", inputs) | conv(f"{name}.conv1", inputs, outputs, 3)
    shapes |= norm(f"{name}.norm2", outputs) | conv(f"{name}.conv2", outputs, outputs, 3)
    return shapes | (conv(f"{name}.nin_shortcut", inputs, outputs, 1) if inputs != outputs else {})


def _taming_attention(name: str, width: int) -> Shapes:
    shapes = norm(f"{name}.norm", width)
    for part in ("q", "k", "v", "proj_out"):
        shapes |= conv(f"{name}.{part}", width, width, 1)
    return shapes


def _taming_middle(name: str, width: int) -> Shapes:
    blocks = _taming_block(f"{name}.mid.block_1", width, width) | _taming_block(f"{name}.mid.block_2", width, width)
    return blocks | _taming_attention(f"{name}.mid.attn_1", width)


def unit(widths: tuple[int, ...] = (128, 128, 256, 512), attention: bool = False) -> Shapes:
    """Shapes of UniT's VQModel: two blocks at each scale, attention at the coarsest or nowhere, and its losses."""
    coarsest = len(widths) - 1
    shapes = conv("encoder.conv_in", 3, widths[0], 3) | conv("decoder.conv_out", widths[0], 3, 3)
    for i, (before, width) in enumerate(zip((widths[0], *widths), widths, strict=False)):
        for j in range(2):
            shapes |= _taming_block(f"encoder.down.{i}.block.{j}", before if j == 0 else width, width)
        above = widths[min(i + 1, coarsest)]
        for j in range(3):
            shapes |= _taming_block(f"decoder.up.{i}.block.{j}", above if j == 0 else width, width)
        shapes |= conv(f"encoder.down.{i}.downsample.conv", width, width, 3) if i < coarsest else {}
        shapes |= conv(f"decoder.up.{i}.upsample.conv", width, width, 3) if i > 0 else {}
    for j in range(3 if attention else 0):
        shapes |= _taming_attention(f"decoder.up.{coarsest}.attn.{j}", widths[-1])
        shapes |= _taming_attention(f"encoder.down.{coarsest}.attn.{j}", widths[-1]) if j < 2 else {}
    shapes |= _taming_middle("encoder", widths[-1]) | _taming_middle("decoder", widths[-1])
    shapes |= norm("encoder.norm_out", widths[-1]) | conv("encoder.conv_out", widths[-1], 3, 3)
    shapes |= norm("decoder.norm_out", widths[0]) | conv("decoder.conv_in", 3, widths[-1], 3)
    shapes |= {"quantize.embedding.weight": (1024, 3), "loss.discriminator.main.0.weight": (64, 3, 4, 4)}
    return shapes | conv("quant_conv", 3, 3, 1) | conv("post_quant_conv", 3, 3, 1)


def unit_head(features: int) -> Shapes:
    """Shapes of the head that policies train over UniT's latents."""
    shapes: Shapes = {}
    for i, (inputs, outputs) in enumerate(((3, 128), (128, 256), (256, 512)), start=1):
        shapes |= conv(f"conv{i}", inputs, outputs, 3) | norm(f"ln{i}", outputs)
    return shapes | linear("mlp_layers.0", 512, 512) | linear("mlp_layers.3", 512, 512) | linear("mlp_layers.6", 512, features)


HEADS = 4
"""Attention heads of the small transformers."""
WIDTHS = (32, 32, 32, 64)
"""Channels of the small VQGAN."""
SMALL = dict(
    t3_encoder=partial(t3_encoder, width=32, depth=1),
    t3_trunk=partial(t3_trunk, width=32, depth=2),
    sparsh=partial(sparsh, width=32, depth=2),
    sparsh_checkpoint=partial(sparsh_checkpoint, width=32, depth=2),
    anytouch=partial(anytouch, width=32, depth=2, hidden=64, projected=16, decoder=8),
    unit=partial(unit, WIDTHS),
    unit_attention=partial(unit, WIDTHS, attention=True),
    unit_head=partial(unit_head, 24),
)
"""Functions that give the shapes of small networks in the authors' nesting and names."""


def values(name: str, seed: int = 0) -> dict[str, torch.Tensor]:
    """The weights of a small network: float32, each drawn by a seed that follows from its name."""
    return {key: _draw(key, shape, seed) for key, shape in SMALL[name]().items()}


def _draw(name: str, shape: tuple[int, ...], seed: int) -> torch.Tensor:
    if name.endswith("frequency_bands"):
        return (10_000.0 ** -(torch.arange(shape[1]) / shape[1])).repeat(2, 1)  # a fixed buffer of Sparsh's
    own = name.removeprefix("teacher_encoder.backbone.")  # the teacher is what the safetensors file holds
    numbers = np.random.default_rng([zlib.crc32(own.encode()), seed]).standard_normal(shape)
    if name.endswith((".bias", "_token", "_tokens", "embedding", "_embed", "position_embedding.weight")):
        numbers = 0.3 * numbers
    elif len(shape) == 1:  # of a norm, or layer scale
        numbers = 1 + 0.3 * numbers
    else:
        numbers = numbers * math.sqrt(2 / max(math.prod(shape[1:]), 1))
    return torch.as_tensor(numbers, dtype=torch.float32)


def picture(rows: int, columns: int, seed: int) -> np.ndarray:
    """A smooth colour picture, uint8 (rows, columns, 3), with a little noise."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:rows, :columns] / rows
    waves = [np.sin(a * y + b * x + c) for a, b, c in rng.uniform(2, 9, (3, 3))]
    return (128 + 90 * np.stack(waves, -1) + 10 * rng.standard_normal((rows, columns, 3))).clip(0, 255).astype(np.uint8)
