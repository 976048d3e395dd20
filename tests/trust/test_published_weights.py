"""Weights that others have published are read, and nothing of their files is run."""

import pickle
import zipfile
from argparse import Namespace
from collections import OrderedDict
from pathlib import Path

import pytest
import torch

from baselines.common.checkpoint import read_tensors
from baselines.tactile_representations.released_weights import read_released
from baselines.tactile_representations.unit import UniT
from manifeel_ms3.evaluation.checkpoint_config import CheckpointError

from .files_of_strangers import Gadget


class CosineSchedule:
    """Stands for a scheduler of the authors, which is pickled whole."""

    def __init__(self):
        self.steps = [1, 2]


def lightning(weights: dict) -> dict:
    """What a training program's checkpoint holds beside its weights."""
    return dict(state_dict=weights, epoch=3, callbacks={CosineSchedule: {"best": 0.5}}, scheduler=CosineSchedule(),
                args=Namespace(lr=1e-4, seen={1, 2}, layers=[CosineSchedule()]), optimizer={"exp": torch.ones(3)})  # fmt: skip


@pytest.mark.parametrize("nested", [lambda w: w, lambda w: {"model": w}, lambda w: {"state_dict": w}, lightning])
def test_b2_published_weights_are_read_and_all_else_left_aside(nested, tmp_path):
    base = torch.arange(24.0).reshape(4, 6)
    weights = OrderedDict(
        whole=base, part=base[1:3, ::2], turned=base.T, half=base.half(), bf=base.bfloat16(), count=torch.tensor(7),
        flags=torch.tensor([True, False]), parameter=torch.nn.Parameter(base), none=torch.zeros(0, 3),
    )  # fmt: skip
    torch.save(nested(weights), tmp_path / "released.ckpt")
    read = read_released(tmp_path / "released.ckpt")
    assert list(read) == list(weights)
    for name, tensor in weights.items():
        assert read[name].dtype == tensor.dtype
        assert torch.equal(read[name], tensor.detach()), name


def test_b2_a_modules_own_state_is_read_as_torch_reads_it(tmp_path):
    state = torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.BatchNorm1d(4)).state_dict()
    torch.save(state, tmp_path / "released.pth")
    read = read_released(tmp_path / "released.pth")
    assert read.keys() == state.keys()
    assert all(torch.equal(read[name], state[name]) for name in state)


class Opens:
    def __reduce__(self):
        return open, ("executed", "w")


class Imports:
    def __reduce__(self):
        return eval, ("__import__('os').system('touch executed')",)


@pytest.mark.parametrize("gadget", [Gadget, Opens, Imports])
@pytest.mark.parametrize("place", ["beside", "within", "alone"])
def test_b2_a_file_of_weights_runs_nothing(gadget, place, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    weights = {"w": torch.ones(2)}
    content = {"beside": {"model": weights, "x": gadget()}, "within": weights | {"x": gadget()}, "alone": gadget()}[place]
    torch.save(content, "released.ckpt")
    if place == "alone":
        with pytest.raises(CheckpointError, match="cannot be read as weights"):
            read_released(Path("released.ckpt"))
    else:
        assert torch.equal(read_released(Path("released.ckpt"))["w"], torch.ones(2))
    assert not Path("executed").exists()
    torch.load("released.ckpt", weights_only=False)
    assert Path("executed").exists()  # the gadget does harm where it is let


def pickled(program: bytes, path: Path) -> Path:
    """A file as torch writes it, around any pickle."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a/data.pkl", program)
        archive.writestr("a/data/0", bytes(16))
    return path


PICKLES = {
    "a list": b"\x80\x02].",
    "no tensors": b"\x80\x02}.",
    "a memo of 64 GB": b"\x80\x02}r\xff\xff\xff\xf0.",
    "an array of 100 GB": b"\x80\x05\x96\x00\x00\x00\x00\x19\x00\x00\x00.",
    "a name from the stack": b"\x80\x04\x8c\x02os\x8c\x06system\x93\x8c\x0etouch executed\x85R.",
    "cut": b"\x80\x02}(X",
    "text": b"no pickle",
    "extension": b"\x80\x02\x82\x01.",
}


@pytest.mark.parametrize("kind", PICKLES)
def test_b2_other_pickles_are_refused(kind, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(CheckpointError, match="cannot be read as weights"):
        read_released(pickled(PICKLES[kind], tmp_path / "x.ckpt"))
    assert not Path("executed").exists()


class Described:
    """A tensor whose place in the file is made up."""

    def __init__(self, *place):
        self.place = place

    def __reduce__(self):
        return torch._utils._rebuild_tensor_v2, (Stored(), *self.place, False, OrderedDict())


class Stored:
    """A storage of four numbers."""


def described(*place) -> bytes:
    import io

    class Pickler(pickle.Pickler):
        def persistent_id(self, obj):
            return ("storage", torch.FloatStorage, "0", "cpu", 4) if isinstance(obj, Stored) else None

    buffer = io.BytesIO()
    Pickler(buffer, 2).dump({"w": Described(*place)})
    return buffer.getvalue()


def test_b2_a_tensor_lies_within_its_file(tmp_path):
    good = read_released(pickled(described(0, (2, 2), (2, 1)), tmp_path / "x.ckpt"))
    assert torch.equal(good["w"], torch.zeros(2, 2))
    for place in [(0, (5,), (1,)), (2, (3,), (1,)), (-1, (2,), (1,)), (0, (2**40,), (0,)), (0, (2,), (-1,)), (0, "ab", "cd"),
                  (0, (2**33, 2**33), (0, 0)), (None, (1,), (1,)), (0, (2,), (2**62,))]:  # fmt: skip
        with pytest.raises(CheckpointError, match="cannot be read as weights"):
            read_released(pickled(described(*place), tmp_path / "x.ckpt"))


def test_b2_programs_of_torch_and_other_files_are_refused(tmp_path):
    torch.jit.script(torch.nn.Linear(2, 2)).save(tmp_path / "script.pth")
    (tmp_path / "text.pth").write_text("no zip")
    for path in (tmp_path / "script.pth", tmp_path / "text.pth", tmp_path / "missing.pth", tmp_path):
        with pytest.raises(CheckpointError, match="cannot be read as weights"):
            read_released(path)
    torch.save({"encoder.down.3.attn.0.q.weight": torch.ones(1), "x.attn.9.p.q": torch.ones(1)}, tmp_path / "other.ckpt")
    with pytest.raises(CheckpointError):
        UniT(channels=(32, 32), attention=True).load(tmp_path / "other.ckpt")


@pytest.mark.parametrize("content", [b"", b"\xff" * 99, b"\x02\0\0\0\0\0\0\0{}x", b"\xff\xff\xff\xff\xff\xff\xff\x7f{}"])
def test_b2_broken_safetensors_are_refused(content, tmp_path):
    (tmp_path / "model.safetensors").write_bytes(content)
    with pytest.raises(CheckpointError, match="cannot be read"):
        read_tensors(tmp_path / "model.safetensors")
