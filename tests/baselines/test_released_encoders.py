"""Released encoders compute what their authors' networks do, read from files as their authors write them."""

import json
import sys
from argparse import Namespace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from baselines.common.observation import prepare_images
from baselines.tactile_representations.anytouch import AnyTouch
from baselines.tactile_representations.representation import Representation
from baselines.tactile_representations.sparsh import Sparsh, untouched_image, upright
from baselines.tactile_representations.t3 import T3
from baselines.tactile_representations.unit import UniT
from manifeel_ms3.errors import UnknownNameError
from manifeel_ms3.evaluation.checkpoint_config import CheckpointError
from tests.sensors.optics import make_optics

from .released_encoders import stand_ins
from .released_encoders.formulae import EXPECTED, UNTOUCHED_COLOUR, probes
from .released_encoders.networks import small_anytouch, small_sparsh, small_t3, small_unit
from .released_encoders.stand_ins import WIDTHS, picture, values

Weights = dict[str, torch.Tensor]


def foreign_class(module: str, name: str, monkeypatch) -> type:
    """A class that a file names and that cannot be imported where the file is read."""
    made = type(name, (), {"__module__": module})
    parts = module.split(".")
    for i in range(1, len(parts) + 1):
        monkeypatch.setitem(sys.modules, ".".join(parts[:i]), ModuleType(".".join(parts[:i])))
    monkeypatch.setattr(sys.modules[module], name, made, raising=False)
    return made


def sparsh_file(folder: Path, monkeypatch) -> Path:
    """As Fabric saves it: the schedulers of the weight decay are pickled whole, by the name of the authors' class."""
    scheduler = foreign_class("tactile_ssl.model.custom_scheduler", "CosineWDSchedule", monkeypatch)()
    scheduler.ref_wd = 0.04
    optimizer = dict(state={0: dict(exp_avg=torch.ones(3))}, param_groups=[dict(lr=1e-4, params=[0])])
    state = dict(model=values("sparsh_checkpoint"), optim=optimizer, scheduler={"last_epoch": 3}, wd_scheduler=scheduler)
    torch.save(state | dict(global_step=7, current_epoch=3), folder / "dino_vitbase.ckpt")
    return folder / "dino_vitbase.ckpt"


def sparsh_safetensors(folder: Path, monkeypatch) -> Path:
    save_file(values("sparsh"), folder / "dino_vitbase.safetensors")
    return folder / "dino_vitbase.safetensors"


def anytouch_file(folder: Path, monkeypatch) -> Path:
    state = dict(optimizer=dict(state={0: dict(step=torch.tensor(3.0))}, param_groups=[]), epoch=11, scaler={})
    state |= dict(model=values("anytouch"), args=Namespace(lr=1e-3, mae_dir=Path("mae")))
    torch.save(state, folder / "checkpoint.pth")
    return folder / "checkpoint.pth"


def anytouch_safetensors(folder: Path, monkeypatch) -> Path:
    save_file(values("anytouch"), folder / "anytouch.safetensors")
    return folder / "anytouch.safetensors"


def t3_folder(folder: Path, monkeypatch) -> Path:
    (folder / "encoders").mkdir()
    torch.save(values("t3_encoder"), folder / "encoders/mini.pth")
    torch.save(values("t3_encoder", seed=1), folder / "encoders/digit.pth")
    torch.save(values("t3_trunk"), folder / "trunk.pth")
    return folder


def unit_file(folder: Path, monkeypatch, name: str = "unit") -> Path:
    """As Lightning 1.0 saves it: its callbacks are named by their classes."""
    callback = foreign_class("pytorch_lightning.callbacks.model_checkpoint", "ModelCheckpoint", monkeypatch)
    state = {"epoch": 49, "pytorch-lightning_version": "1.0.8", "callbacks": {callback: {"best_model_score": torch.ones(1)}}}
    state |= dict(state_dict=values(name), optimizer_states=[], hyper_parameters={"embed_dim": 3})
    torch.save(state, folder / "last.ckpt")
    return folder / "last.ckpt"


def unit_attention_file(folder: Path, monkeypatch) -> Path:
    return unit_file(folder, monkeypatch, "unit_attention")


def loaded(network: Representation, write, folder: Path) -> Representation:
    """The network with the weights of a file, whose writer's classes are gone before it is read."""
    with pytest.MonkeyPatch.context() as patch:
        path = write(folder, patch)
    network.load(path)
    return network


def as_input(image: np.ndarray) -> torch.Tensor:
    """A picture as policies give it to the network."""
    return torch.as_tensor(image).movedim(-1, 0)[None].float() / 127.5 - 1


def assert_as_expected(name: str, output: torch.Tensor) -> None:
    expected = json.loads(EXPECTED.read_text(encoding="utf-8"))[name]
    np.testing.assert_allclose(probes(output), expected, rtol=0, atol=1e-5)


@torch.no_grad()
def test_t3_normalises_by_the_data_and_gives_the_class_token(tmp_path):
    network = loaded(small_t3(), t3_folder, tmp_path)
    data = np.stack([picture(224, 224, seed=1), picture(224, 224, seed=2)])
    network.fit([torch.as_tensor(data[:1]), torch.as_tensor(data[1:])])
    assert_as_expected("t3", network(as_input(data[0])))


@torch.no_grad()
@pytest.mark.parametrize("write", [sparsh_safetensors, sparsh_file])
def test_sparsh_sees_the_upright_difference_from_the_untouched_sensor(write, tmp_path):
    network = loaded(small_sparsh(), write, tmp_path)
    untouched = picture(240, 320, seed=2)
    network.untouched.copy_(torch.as_tensor(np.rot90(untouched, -1).copy()).movedim(-1, 0))
    assert_as_expected("sparsh", network(as_input(picture(240, 320, seed=1))))
    network.untouched.copy_(torch.tensor(UNTOUCHED_COLOUR)[:, None, None])
    assert_as_expected("sparsh_224", network(as_input(picture(224, 224, seed=1))))


@torch.no_grad()
@pytest.mark.parametrize("write", [anytouch_file, anytouch_safetensors])
def test_anytouch_stacks_frames_first_and_gives_the_projected_class_token(write, tmp_path):
    network = loaded(small_anytouch(), write, tmp_path)
    image = as_input(picture(224, 224, seed=1))
    assert_as_expected("anytouch", network(image))
    network.choose_sensor("digit")
    assert_as_expected("anytouch_digit", network(image))


@torch.no_grad()
def test_unit_sees_pictures_from_zero_to_one(tmp_path):
    image = as_input(picture(64, 64, seed=1))
    network = loaded(small_unit(), unit_file, tmp_path)
    assert_as_expected("unit", network(image))
    head = network.head(24)
    with torch.no_grad():
        for parameter, tensor in zip(head.parameters(), values("unit_head").values(), strict=True):
            parameter.copy_(tensor)
    assert_as_expected("unit_head", head(network(image)))
    assert_as_expected("unit_attention", loaded(small_unit(attention=True), unit_attention_file, tmp_path)(image))


def test_t3_reads_the_encoder_of_the_chosen_sensor(tmp_path):
    network = small_t3()
    network.choose_sensor("digit")
    loaded(network, t3_folder, tmp_path)
    assert torch.equal(network.encoder.cls_token, values("t3_encoder", seed=1)["cls_token"])
    network.choose_sensor("wedge")
    with pytest.raises(CheckpointError, match=r"lacks encoders/wedge.pth; give the folder t3_medium"):
        network.load(tmp_path)


def test_an_unknown_sensor_is_refused():
    with torch.device("meta"):
        for network, message in (
            (small_t3(), r"not a sensor of T3; choose from \['mini', 'gs_green'"),
            (small_anytouch(), r"not a sensor of AnyTouch; choose from \['gelsight', 'digit'"),
            (UniT(WIDTHS), "not a sensor of UniT; it has the same weights for all"),
        ):
            with pytest.raises(UnknownNameError, match=message):
                network.choose_sensor("gs_pink")


@pytest.mark.parametrize(
    ("make", "write"),
    [
        *((small_sparsh, write) for write in (anytouch_file, anytouch_safetensors, unit_file)),
        *((small_anytouch, write) for write in (sparsh_file, sparsh_safetensors, unit_file)),
        *((small_unit, write) for write in (sparsh_file, sparsh_safetensors, anytouch_file)),
    ],
)
def test_weights_of_another_network_are_refused_in_one_line(make, write, tmp_path):
    network = make()
    with pytest.raises(CheckpointError, match=f"another network than {type(network).__name__}.*; give ") as caught:
        loaded(network, write, tmp_path)
    assert "\n" not in str(caught.value)
    assert network.released in str(caught.value)


def test_weights_that_are_no_numbers_of_weights_are_refused(tmp_path):
    save_file({name: tensor.to(torch.int8) for name, tensor in values("sparsh").items()}, tmp_path / "bytes.safetensors")
    with pytest.raises(CheckpointError, match="another network than Sparsh: 34 tensors do not fit"):
        small_sparsh().load(tmp_path / "bytes.safetensors")


@pytest.mark.parametrize("name", ["broken.ckpt", "broken.safetensors", "missing.ckpt", "missing.safetensors"])
def test_a_file_that_cannot_be_read_is_named_with_the_one_that_can(name, tmp_path):
    (tmp_path / "broken.ckpt").write_bytes(b"not weights")
    (tmp_path / "broken.safetensors").write_bytes(b"not weights")
    with pytest.raises(CheckpointError, match=f"{name} cannot be read") as caught:
        small_sparsh().load(tmp_path / name)
    assert "\n" not in str(caught.value)
    if name == "broken.ckpt":
        assert "give dino_vitbase.safetensors" in str(caught.value)


def test_released_weights_take_no_statistics_from_other_data(tmp_path):
    """The weights of `pretrain.py` bring the statistics of their images; the authors' bring none, and leave ours."""
    network = small_t3()
    network.fit([torch.full((1, 2, 2, 3), 51, dtype=torch.uint8)])
    loaded(network, t3_folder, tmp_path)
    assert torch.allclose(network.normalisation.mean, torch.tensor(0.2))
    assert torch.allclose(network.normalisation.std, torch.tensor(1 / 255))  # of a uniform picture: one grey level


def test_sparsh_sees_nothing_where_nothing_touches():
    image = make_optics().shade(torch.zeros(1, 240, 320)).numpy()[0]
    assert np.array_equal(image, untouched_image())
    network = small_sparsh()
    assert network.prepare(as_input(image)).unique().tolist() == pytest.approx([127 / 255])  # 0.5, cut to whole grey levels
    square = network.prepare(as_input(prepare_images(image[None], 224)[0]))
    assert (square - 127 / 255).abs().max() < 1.01 / 255  # images are rounded to grey levels when they are resized


def test_pictures_of_any_form_come_upright():
    image = torch.arange(240.0)[:, None].expand(1, 1, 240, 320)
    assert upright(image)[0, 0, :, -1].unique().tolist() == [0]  # the first row becomes the last column
    assert torch.equal(upright(upright(image)), upright(image))
    square = torch.rand(1, 3, 64, 64)
    assert torch.equal(upright(square), square.rot90(-1, (2, 3)))
    long = torch.arange(336.0)[:, None].expand(1, 1, 336, 240)
    assert upright(long).shape[2:] == (320, 240)
    assert upright(long).min() >= 42 - 1e-3  # of 336 rows the middle 252, three quarters
    assert upright(long).max() <= 293 + 1e-3


T3_SHAPES = {f"encoder.{name}": shape for name, shape in stand_ins.t3_encoder().items()}
T3_SHAPES |= {f"trunk.{name}": shape for name, shape in stand_ins.t3_trunk().items()}


@pytest.mark.parametrize(
    ("make", "shapes"),
    [
        (T3, T3_SHAPES),
        (Sparsh, stand_ins.sparsh()),
        (Sparsh, stand_ins.sparsh_checkpoint()),
        (AnyTouch, stand_ins.anytouch()),
        (UniT, stand_ins.unit()),
        (lambda: UniT(attention=True), stand_ins.unit(attention=True)),
    ],
    ids=["t3", "sparsh", "sparsh_checkpoint", "anytouch", "unit", "unit_released"],
)
def test_files_of_the_real_size_fit_name_by_name(make, shapes):
    with torch.device("meta"):
        network = make()
        converted = network.convert_state_dict({name: torch.empty(shape) for name, shape in shapes.items()})
    own = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items() if "normalisation." not in name}
    assert {name: tuple(tensor.shape) for name, tensor in converted.items()} == own
