"""Tactile representations: published weights fit, pictures alone can train them, policies can use them."""

import json
from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch
from transformers import CLIPVisionConfig, ViTConfig, ViTModel

from baselines.common.encoders import TACRGB_ENCODERS, EncoderConfig, ObservationEncoder, load_pretrained
from baselines.common.memory import lay_out_channels_last
from baselines.common.observation import POSE, observation_spec
from baselines.tactile_representations import pretrain
from baselines.tactile_representations.anytouch import AnyTouch
from baselines.tactile_representations.encoder import RepresentationEncoder
from baselines.tactile_representations.pretrain import patch_discriminator
from baselines.tactile_representations.sparsh import Sparsh
from baselines.tactile_representations.t3 import T3
from baselines.tactile_representations.unit import UniT
from manifeel_ms3.demonstrations import DemonstrationError
from manifeel_ms3.evaluation.checkpoint_config import CheckpointError
from tests.conftest import PEG

SPEC = observation_spec("tacrgb", (), ("right",), 32)
Shapes = dict[str, tuple[int, ...]]


def small_t3() -> T3:
    return T3(width=32, depth=(1, 2), heads=4)


def linear(name: str, inputs: int, outputs: int) -> Shapes:
    return {f"{name}.weight": (outputs, inputs), f"{name}.bias": (outputs,)}


def norm(name: str, width: int) -> Shapes:
    return {f"{name}.weight": (width,), f"{name}.bias": (width,)}


def conv(name: str, inputs: int, outputs: int, size: int) -> Shapes:
    return {f"{name}.weight": (outputs, inputs, size, size), f"{name}.bias": (outputs,)}


def timm_blocks(prefix: str, count: int, width: int = 768) -> Shapes:
    shapes: Shapes = {}
    for i in range(count):
        block = f"{prefix}blocks.{i}"
        shapes |= norm(f"{block}.norm1", width) | norm(f"{block}.norm2", width)
        shapes |= linear(f"{block}.attn.qkv", width, 3 * width) | linear(f"{block}.attn.proj", width, width)
        shapes |= linear(f"{block}.mlp.fc1", width, 4 * width) | linear(f"{block}.mlp.fc2", 4 * width, width)
    return shapes


def published_t3() -> Shapes:
    """encoders/gs_green.pth and trunk.pth, each under its part's name."""
    shapes = {"encoder.cls_token": (1, 1, 768), "encoder.pos_embed": (1, 197, 768)}
    shapes |= conv("encoder.patch_embed.proj", 3, 768, 16) | timm_blocks("encoder.", 3)
    return shapes | timm_blocks("trunk.", 9) | norm("trunk.norm", 768)


def published_sparsh() -> Shapes:
    prefix = "teacher_encoder.backbone."
    shapes = {f"{prefix}register_tokens": (1, 1, 768), f"{prefix}pos_embed.frequency_bands": (2, 192)}
    shapes |= conv(f"{prefix}patch_embed.proj", 6, 768, 16) | timm_blocks(prefix, 12) | norm(f"{prefix}norm", 768)
    for i in range(12):
        shapes |= {f"{prefix}blocks.{i}.ls{k}.gamma": (768,) for k in (1, 2)}
    return shapes | {"student_encoder.backbone.register_tokens": (1, 1, 768)}


def published_anytouch() -> Shapes:
    """Of the second stage; what only its training needs goes by other names."""
    outer, model = "touch_mae_model.", "touch_mae_model.touch_model."
    shapes = {f"{outer}sensor_token": (10, 5, 1024), f"{outer}video_patch_embedding.weight": (1024, 3, 3, 14, 14)}
    shapes |= {f"{outer}touch_projection.weight": (768, 1024), f"{model}embeddings.class_embedding": (1024,)}
    shapes |= {f"{model}embeddings.patch_embedding.weight": (1024, 3, 14, 14)}
    shapes |= {f"{model}embeddings.position_embedding.weight": (257, 1024), f"{outer}sensor_token_proj.weight": (512, 1024)}
    shapes |= norm(f"{model}pre_layrnorm", 1024) | norm(f"{model}post_layernorm", 1024)
    for i in range(24):
        layer = f"{model}encoder.layers.{i}"
        shapes |= norm(f"{layer}.layer_norm1", 1024) | norm(f"{layer}.layer_norm2", 1024)
        for part in ("k_proj", "v_proj", "q_proj", "out_proj"):
            shapes |= linear(f"{layer}.self_attn.{part}", 1024, 1024)
        shapes |= linear(f"{layer}.mlp.fc1", 1024, 4096) | linear(f"{layer}.mlp.fc2", 4096, 1024)
    return shapes


def taming_block(name: str, inputs: int, outputs: int) -> Shapes:
    shapes = norm(f"{name}.norm1", inputs) | conv(f"{name}.conv1", inputs, outputs, 3)
    shapes |= norm(f"{name}.norm2", outputs) | conv(f"{name}.conv2", outputs, outputs, 3)
    return shapes | (conv(f"{name}.nin_shortcut", inputs, outputs, 1) if inputs != outputs else {})


def taming_attention(name: str, width: int) -> Shapes:
    shapes = norm(f"{name}.norm", width)
    for part in ("q", "k", "v", "proj_out"):
        shapes |= conv(f"{name}.{part}", width, width, 1)
    return shapes


def taming_middle(name: str, width: int) -> Shapes:
    blocks = taming_block(f"{name}.mid.block_1", width, width) | taming_block(f"{name}.mid.block_2", width, width)
    return blocks | taming_attention(f"{name}.mid.attn_1", width)


def published_unit(attention: bool) -> Shapes:
    """VQModel of taming-transformers: 128 channels times 1, 1, 2, 4, two blocks each, attention at the coarsest."""
    widths = (128, 128, 256, 512)
    shapes = conv("encoder.conv_in", 3, 128, 3) | conv("decoder.conv_out", 128, 3, 3)
    for i, (before, width) in enumerate(zip((128, *widths), widths, strict=False)):
        for j in range(2):
            shapes |= taming_block(f"encoder.down.{i}.block.{j}", before if j == 0 else width, width)
        above = widths[min(i + 1, 3)]
        for j in range(3):
            shapes |= taming_block(f"decoder.up.{i}.block.{j}", above if j == 0 else width, width)
        shapes |= conv(f"encoder.down.{i}.downsample.conv", width, width, 3) if i < 3 else {}
        shapes |= conv(f"decoder.up.{i}.upsample.conv", width, width, 3) if i > 0 else {}
    for j in range(3 if attention else 0):
        shapes |= taming_attention(f"decoder.up.3.attn.{j}", 512)
        shapes |= taming_attention(f"encoder.down.3.attn.{j}", 512) if j < 2 else {}
    shapes |= taming_middle("encoder", 512) | taming_middle("decoder", 512)
    shapes |= norm("encoder.norm_out", 512) | conv("encoder.conv_out", 512, 3, 3)
    shapes |= norm("decoder.norm_out", 128) | conv("decoder.conv_in", 3, 512, 3)
    shapes |= {"quantize.embedding.weight": (1024, 3), "loss.discriminator.main.0.weight": (64, 3, 4, 4)}
    return shapes | conv("quant_conv", 3, 3, 1) | conv("post_quant_conv", 3, 3, 1)


@pytest.mark.parametrize(
    ("make", "published"),
    [(T3, published_t3()), (Sparsh, published_sparsh()), (AnyTouch, published_anytouch())]
    + [(lambda a=attention: UniT(attention=a).saved, published_unit(attention)) for attention in (False, True)],
    ids=["t3", "sparsh", "anytouch", "unit", "unit_released"],
)
def test_published_weights_fit_name_by_name(make, published):
    with torch.device("meta"):
        representation = make()
        weights = {name: torch.empty(shape) for name, shape in published.items()}
    own = {name: tuple(tensor.shape) for name, tensor in representation.state_dict().items()}
    assert {name: tuple(tensor.shape) for name, tensor in representation.convert_state_dict(weights).items()} == own


def millions(module: torch.nn.Module) -> float:
    return sum(parameter.numel() for parameter in module.parameters()) / 1e6


def test_representations_have_the_published_sizes():
    with torch.device("meta"):
        assert millions(T3()) == pytest.approx(86, rel=0.02)
        assert millions(AnyTouch()) == pytest.approx(305, rel=0.02)
        assert millions(Sparsh()) == pytest.approx(86, rel=0.02)
        # the published 75 M are the VQGAN with what its training judges it by: VGG-16's convolutions and the discriminator
        judges = 14.71 + millions(patch_discriminator())
        assert millions(UniT().vqgan) + judges == pytest.approx(75, rel=0.02)


def test_t3_computes_what_a_vision_transformer_computes():
    """Against the ViT of transformers, which has other names and no shared code."""
    torch.manual_seed(0)
    ours = small_t3().eval()
    torch.nn.init.normal_(ours.encoder.cls_token)
    config = ViTConfig(hidden_size=32, num_hidden_layers=3, num_attention_heads=4, intermediate_size=128, layer_norm_eps=1e-6)
    theirs = ViTModel(config, add_pooling_layer=False).eval()
    weights = list(theirs.state_dict())
    copied = {"embeddings.cls_token": ours.encoder.cls_token, "embeddings.position_embeddings": ours.encoder.pos_embed}
    projection = ours.encoder.patch_embed.proj
    for kind in ("weight", "bias"):
        copied[f"embeddings.patch_embeddings.projection.{kind}"] = getattr(projection, kind)
        copied[f"layernorm.{kind}"] = getattr(ours.trunk.norm, kind)
        for i, block in enumerate((*ours.encoder.blocks, *ours.trunk.blocks)):
            layer = next(
                prefix for prefix in (f"encoder.layer.{i}.", f"layers.{i}.") if any(n.startswith(prefix) for n in weights)
            )
            for name in [name for name in weights if name.startswith(layer) and name.endswith(kind)]:
                copied[name] = _theirs(name.removeprefix(layer).removesuffix(f".{kind}"), block, kind)
    assert set(copied) == set(weights)
    theirs.load_state_dict(copied)
    image = torch.rand(2, 3, 224, 224) * 2 - 1
    with torch.no_grad():
        tokens = theirs(imagenet_normalised(image)).last_hidden_state
        assert torch.allclose(ours(image), tokens[:, 1:].mean(1), atol=1e-5)


def imagenet_normalised(image: torch.Tensor) -> torch.Tensor:
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    return ((image + 1) / 2 - mean[:, None, None]) / std[:, None, None]


def _theirs(name: str, block: torch.nn.Module, kind: str) -> torch.Tensor:
    """A weight of a timm block by what transformers calls it."""
    thirds = dict(zip(("q", "k", "v"), getattr(block.attn.qkv, kind).chunk(3), strict=True))
    for letter, word in (("q", "query"), ("k", "key"), ("v", "value")):
        if word in name or f"{letter}_proj" in name:
            return thirds[letter]
    if "before" in name or "norm1" in name:
        return getattr(block.norm1, kind)
    if "after" in name or "norm2" in name:
        return getattr(block.norm2, kind)
    if "intermediate" in name or "fc1" in name:
        return getattr(block.mlp.fc1, kind)
    if "attention" in name or "o_proj" in name:
        return getattr(block.attn.proj, kind)
    return getattr(block.mlp.fc2, kind)


def test_released_folder_of_t3_is_read(tmp_path):
    torch.manual_seed(0)
    source, other = small_t3(), small_t3()
    (tmp_path / "encoders").mkdir()
    torch.save(source.encoder.state_dict(), tmp_path / "encoders/gs_green.pth")
    with pytest.raises(CheckpointError, match=r"lacks .*trunk.pth"):
        other.load(tmp_path)
    torch.save(source.trunk.state_dict(), tmp_path / "trunk.pth")
    other.load(tmp_path)
    image = torch.rand(1, 3, 64, 64)
    assert torch.equal(source(image), other(image))


def test_released_unit_asks_for_its_own_architecture():
    with torch.device("meta"):
        weights = {name: torch.empty(shape) for name, shape in published_unit(attention=True).items()}
        with pytest.raises(CheckpointError, match="unit_released"):
            UniT().saved.convert_state_dict(weights)


def test_weights_of_something_else_are_refused(tmp_path):
    torch.save(dict(model=dict(weight=torch.zeros(3))), tmp_path / "other.ckpt")
    with pytest.raises(CheckpointError, match="facebook/sparsh-dino-base"):
        Sparsh(32, 1, 4).load(tmp_path / "other.ckpt")
    (tmp_path / "broken.ckpt").write_bytes(b"not weights")
    with pytest.raises(CheckpointError, match="cannot be read as weights"):
        Sparsh(32, 1, 4).load(tmp_path / "broken.ckpt")


TINY_CLIP = CLIPVisionConfig(
    hidden_size=32, intermediate_size=64, num_hidden_layers=2, num_attention_heads=4, patch_size=14, projection_dim=16
)
SMALL = dict(
    t3=(small_t3, 32),
    sparsh=(lambda: Sparsh(32, 2, 4), 32),
    anytouch=(lambda: AnyTouch(TINY_CLIP), 42),
    unit=(lambda: UniT(channels=(32, 32, 32, 64), out_features=16), 32),
)


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """A trajectory file of TacRGB: dark spots on a bright gel."""
    path = tmp_path_factory.mktemp("touch") / "trajectory.h5"
    y, x = np.mgrid[:48, :64]
    frames = [
        200 - 120 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / 60)
        for cx, cy in np.random.default_rng(0).uniform([10, 10], [54, 38], (24, 2))
    ]
    with h5py.File(path, "w") as file:
        file["traj_0/obs/sensor_data/tactile_right/rgb"] = np.repeat(np.array(frames)[..., None], 3, -1).astype(np.uint8)
        file["traj_0/obs/sensor_data/wrist/rgb"] = np.zeros((24, 8, 8, 3), np.uint8)
    episode = dict(episode_id=0, episode_seed=0, elapsed_steps=23, success=True)
    header = dict(env_info=dict(env_id=PEG, env_kwargs={}), episodes=[episode])
    path.with_suffix(".json").write_text(json.dumps(header))
    return path


@pytest.mark.parametrize("name", SMALL)
def test_pictures_alone_train_a_representation(name, pictures, tmp_path, monkeypatch):
    make, size = SMALL[name]
    monkeypatch.setitem(pretrain.REPRESENTATIONS, name, make)
    steps = 60
    sizes = dict(image_size=size, batch_size=8, steps=steps, lr=2e-3, adversary_from=50, log_every=1, device="cpu")
    losses = pretrain.main(pretrain.Args(name, (pictures,), tmp_path / "weights.safetensors", **sizes))
    assert np.mean(losses[-5:]) < 0.9 * np.mean(losses[:3])
    fresh = RepresentationEncoder(make(), size, 64)
    before = [parameter.clone() for parameter in fresh.parameters()]
    load_pretrained(torch.nn.Sequential(fresh), tmp_path / "weights.safetensors")
    assert any(not torch.equal(old, new) for old, new in zip(before, fresh.parameters(), strict=True))
    assert fresh(torch.zeros(2, 3, size, size)).shape == (2, 64)


def test_files_without_tacrgb_are_named(demos, tmp_path):
    with pytest.raises(DemonstrationError, match="hold no TacRGB"):
        pretrain.main(pretrain.Args("t3", (demos,), tmp_path / "weights.safetensors"))


def observation() -> dict[str, torch.Tensor]:
    return {POSE: torch.rand(2, 1, 9), SPEC.images[0]: torch.randint(0, 255, (2, 1, 32, 32, 3), dtype=torch.uint8)}


@pytest.mark.parametrize("frozen", [True, False])
def test_a_frozen_representation_stays_as_it_was(frozen, monkeypatch):
    monkeypatch.setattr("baselines.tactile_representations.encoder.T3", small_t3)
    encoder = ObservationEncoder(EncoderConfig(tacrgb="t3", freeze_tacrgb=frozen), SPEC, 1)
    encoder(observation()).square().mean().backward()
    (network,) = encoder.images
    assert network.out.weight.grad is not None
    trained = [parameter for parameter in network.representation.parameters() if parameter.grad is not None]
    assert bool(trained) is not frozen


def test_settings_that_do_not_fit_are_named(tmp_path):
    with pytest.raises(ValueError, match="a multiple of 16, not 30; give --tactile-image-size 224"):
        ObservationEncoder(EncoderConfig(tacrgb="sparsh"), replace(SPEC, tactile_image_size=30), 1)
    with pytest.raises(ValueError, match="'resnet18' is no representation"):
        ObservationEncoder(EncoderConfig(freeze_tacrgb=True), SPEC, 1)
    with pytest.raises(ValueError, match="no network of this policy takes them"):
        load_pretrained(ObservationEncoder(EncoderConfig(), SPEC, 1), tmp_path / "weights.safetensors")


@pytest.mark.parametrize("name", TACRGB_ENCODERS)
def test_every_network_of_touch_can_be_laid_out_for_training(name):
    with torch.device("meta"):
        encoder = TACRGB_ENCODERS[name](224, 512)
    lay_out_channels_last(encoder)  # of weights of other ranks, a video's say, nothing is asked
    laid_out = [p.is_contiguous(memory_format=torch.channels_last) for p in encoder.parameters() if p.dim() == 4]
    assert all(laid_out)
