"""Files from strangers: nothing of them is run, nothing outside of them is read, and no more memory is taken than they hold.

Every test hands over a file that did its harm once; the marker that it leaves, or the text that it reads, is looked for.
"""

import json
import os
import pickle
import shutil
import subprocess
import sys
import zipfile
from argparse import Namespace
from collections import OrderedDict
from contextlib import suppress
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from baselines.common.checkpoint import read_tensors
from baselines.tactile_representations.released_weights import read_released
from baselines.tactile_representations.unit import UniT
from manifeel_ms3.demonstrations import DemonstrationError, read_demonstrations, render_observations, replay, view
from manifeel_ms3.demonstrations.export import Args
from manifeel_ms3.demonstrations.export import main as export
from manifeel_ms3.demonstrations.formats import diffusion_policy_zarr, lerobot
from manifeel_ms3.demonstrations.formats.maniskill_h5 import open_trajectories
from manifeel_ms3.demonstrations.summary import summary
from manifeel_ms3.demonstrations.validate import validate
from manifeel_ms3.errors import ManifeelError
from manifeel_ms3.evaluation.checkpoint_config import CheckpointError
from manifeel_ms3.evaluation.policy import PolicySource, load_policy
from tests.conftest import PEG

REPOSITORY = Path(__file__).parents[2]
SAMPLE = REPOSITORY / "data/sample" / PEG
LEROBOT = REPOSITORY / "tests/demonstrations/lerobot"
KEYS = ["sensor_data/wrist/rgb", "sensor_data/tactile_right/force_field", "extra/tcp_pose"]
SECRET = b"TOP SECRET TEXT OF ANOTHER FILE."
EXECUTED = "import pathlib; pathlib.Path('executed').touch()\n"


@pytest.fixture
def demo(tmp_path) -> Path:
    """A copy of the sample's trajectory file, to be spoiled."""
    for name in ("trajectory.h5", "trajectory.json"):
        shutil.copy(SAMPLE / name, tmp_path)
    return tmp_path / "trajectory.h5"


@pytest.fixture
def secret(tmp_path) -> Path:
    path = tmp_path / "elsewhere/secret.txt"
    path.parent.mkdir()
    path.write_bytes(SECRET)
    return path


def rewrite_json(path: Path, change) -> None:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


# ------------------------------------------------------------------ A11: checkpoints name policies, never code


GADGETS = [
    {"kind": "site:addsitedir"},
    {"kind": "os:system"},
    {"kind": "shutil:rmtree"},
    {"kind": "baselines.common.agent:PolicyAgent", "policy_class": "gadget:Policy"},
    *(
        {"policy_name": name}
        for name in ("site:addsitedir", "os:system", "gadget", "gadget:Policy", "../gadget", "this", 5, [])
    ),
    {"policy_name": "baselines.diffusion_policy.train:SPEC"},
    {"policy_name": "diffusion_policy", "policy_class": "gadget:Policy", "policy": {"encoder": "gadget:Policy"}},
]


@pytest.mark.parametrize("config", GADGETS, ids=str)
def test_a11_a_checkpoint_runs_nothing_that_its_config_names(config, tmp_path, monkeypatch):
    folder = tmp_path / "touch executed"  # what `os:system` once ran
    folder.mkdir()
    (folder / "config.json").write_text(json.dumps(config))
    (folder / "gadget.pth").write_text(EXECUTED)  # what `site:addsitedir` once ran
    (tmp_path / "gadget.py").write_text(EXECUTED)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    for load in (lambda: load_policy(folder), PolicySource(checkpoint=folder).make):
        with pytest.raises(CheckpointError):
            load()
    assert (folder / "config.json").is_file()
    assert not (tmp_path / "executed").exists()
    assert "gadget" not in sys.modules


# ------------------------------------------------------------------ A12: environment ids of files


@pytest.fixture
def gadget(tmp_path, monkeypatch) -> Path:
    """A folder that is on the path of modules, as the current one is with `python -m`; its module leaves a marker."""
    (tmp_path / "gadget.py").write_text(EXECUTED)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


def naming(env_id: str, name: str, folder: Path) -> Path:
    """A trajectory file of a set whose json has this id."""
    for suffix in (".h5", ".json"):
        shutil.copy(SAMPLE / f"{name}{suffix}", folder)
    rewrite_json(folder / f"{name}.json", lambda header: header["env_info"].update(env_id=env_id))
    about = {"schema": "manifeel-demonstrations-1", "files": {f"{name}.h5": {"success": 2}}}
    (folder / "manifest.json").write_text(json.dumps(about))
    return folder / f"{name}.h5"


def test_a12_replay_from_the_command_line_imports_no_module_of_the_file(gadget):
    path = naming("gadget:ManiFeel-PegInsertion-v1", "states", gadget)
    command = [sys.executable, "-m", "manifeel_ms3.demonstrations.replay", str(path), "--num", "1"]
    done = subprocess.run(
        command, env=os.environ | {"PYTHONPATH": str(REPOSITORY)}, capture_output=True, text=True, check=False
    )
    assert "of 1 episodes succeed again" in done.stdout + done.stderr
    assert not (gadget / "executed").exists()


READ_ENV_ID = {
    "replay": lambda path: replay.replay(path, 1),
    "validate": lambda path: validate(path.parent, 1),
    "render_observations": lambda path: render_observations.main(
        render_observations.Args(path, path.with_name("out.h5"), "tacff", (), ("right",), num=1)
    ),
    "summary": summary,
    "view": lambda path: view.read_streams(path, 0),
    "export": lambda path: export(Args(path, "npz", path.with_name("out"))),
}


@pytest.mark.parametrize("env_id", ["gadget:Other-v1", "gadget:ManiFeel-PegInsertion-v1"])
@pytest.mark.parametrize("command", READ_ENV_ID)
def test_a12_no_module_that_a_file_names_is_imported(command, env_id, gadget):
    if command == "render_observations" and "Peg" in env_id:
        pytest.skip("it renders in worker processes, which the test of the command line stands for")
    path = naming(env_id, "trajectory" if command in ("view", "export") else "states", gadget)
    with suppress(ManifeelError):
        READ_ENV_ID[command](path)
    assert not (gadget / "executed").exists()
    assert "gadget" not in sys.modules


# ------------------------------------------------------------------ A25: h5 names other files or declares what it lacks


def with_dataset(path: Path, make) -> None:
    """Replace the actions of the first episode by what `make` puts there."""
    with h5py.File(path, "r+") as file:
        del file["traj_0/actions"]
        make(file["traj_0"])


def declared(group, shape: tuple[int, ...], **options) -> None:
    """A data set of which nothing is stored."""
    space, kind = h5py.h5s.create_simple(shape), h5py.h5t.IEEE_F32LE
    group.create_dataset("actions", shape, "f4", **options) if options else h5py.h5d.create(group.id, b"actions", kind, space)


def virtual(group, secret: Path) -> None:
    layout = h5py.VirtualLayout((4, 6), "f4")
    layout[:] = h5py.VirtualSource(str(secret), "x", (4, 6))
    group.create_virtual_dataset("actions", layout)


def second_place(group, _secret: Path) -> None:
    group["actions"] = group["obs/extra/tcp_pose"]


HARM = {
    "external storage": lambda group, secret: group.create_dataset("actions", (2, 4), "f4", external=[(str(secret), 0, 32)]),
    "external link": lambda group, secret: group.update({"actions": h5py.ExternalLink(str(secret), "/x")}),
    "soft link": lambda group, _: group.update({"actions": h5py.SoftLink("/traj_0/obs/extra/tcp_pose")}),
    "virtual data set": virtual,
    "hard link": second_place,
    "2**40 numbers, contiguous": lambda group, _: declared(group, (2**20, 2**20)),
    "2**40 numbers, in chunks": lambda group, _: declared(group, (2**20, 2**20), chunks=(1, 6), compression="gzip"),
    "2**64 numbers": lambda group, _: declared(group, (2**32, 2**32), chunks=(1, 6), compression="gzip"),
    "another filter": lambda group, _: group.create_dataset("actions", data=np.zeros((4, 6)), scaleoffset=3),
    "strings": lambda group, _: group.create_dataset("actions", data=[["text"]]),
    "references": lambda group, _: group.create_dataset("actions", data=[[group.ref]], dtype=h5py.ref_dtype),
    "a group": lambda group, _: group.create_group("actions"),
    "another shape": lambda group, _: group.create_dataset("actions", data=np.zeros(6)),
    "no numbers": lambda group, _: group.create_dataset("actions", data=np.zeros((0, 6))),
}


@pytest.mark.parametrize("kind", HARM)
def test_a25_a_trajectory_file_is_refused(kind, demo, secret):
    with_dataset(demo, lambda group: HARM[kind](group, secret))
    for read in (
        lambda: read_demonstrations(demo, KEYS),
        lambda: summary(demo),
        lambda: export(Args(demo, "npz", demo.parent / "o")),
    ):
        with pytest.raises(DemonstrationError, match="trajectory"):
            read()


@pytest.mark.parametrize(
    ("file", "place"),
    [
        ("../elsewhere/other.h5", "traj_0"),
        ("trajectory.episodes/../elsewhere/other.h5", "traj_0"),
        ("trajectory.episodes/link.h5", "traj_0"),
        ("trajectory.episodes/seed_00000000.h5", "traj_1"),
        ("trajectory.episodes/missing.h5", "traj_0"),
    ],
)
def test_a25_an_index_links_to_its_own_episodes_alone(file, place, tmp_path, secret):
    shutil.copy(SAMPLE / "trajectory.json", tmp_path)
    episodes, other = tmp_path / "trajectory.episodes", secret.with_name("other.h5")
    episodes.mkdir()
    for target in (other, episodes / "seed_00000000.h5"):
        shutil.copy(SAMPLE / "trajectory.h5", target)
    (episodes / "link.h5").symlink_to(other)
    with h5py.File(tmp_path / "trajectory.h5", "w") as index:
        index["traj_0"] = h5py.ExternalLink(file, place)
    with pytest.raises(DemonstrationError, match="index"):
        read_demonstrations(tmp_path / "trajectory.h5", KEYS, num=1)
    with h5py.File(tmp_path / "trajectory.h5", "w") as index:
        index["traj_0"] = h5py.ExternalLink("trajectory.episodes/seed_00000000.h5", "traj_0")
    assert len(read_demonstrations(tmp_path / "trajectory.h5", KEYS, num=1)) == 1


def test_a25_an_episode_of_an_index_is_checked_too(tmp_path, secret):
    shutil.copy(SAMPLE / "trajectory.json", tmp_path)
    episodes = tmp_path / "trajectory.episodes"
    episodes.mkdir()
    shutil.copy(SAMPLE / "trajectory.h5", episodes / "seed_00000000.h5")
    with_dataset(episodes / "seed_00000000.h5", lambda group: HARM["external storage"](group, secret))
    with h5py.File(tmp_path / "trajectory.h5", "w") as index:
        index["traj_0"] = h5py.ExternalLink("trajectory.episodes/seed_00000000.h5", "traj_0")
    with (
        pytest.raises(DemonstrationError, match="are in another file"),
        open_trajectories(tmp_path / "trajectory.h5") as file,
    ):
        file["traj_0/actions"][()]


# ------------------------------------------------------------------ A29, B7: LeRobot


@pytest.fixture
def images(tmp_path) -> Path:
    return shutil.copytree(LEROBOT / "images", tmp_path / "images")


@pytest.fixture
def videos(tmp_path) -> Path:
    return shutil.copytree(LEROBOT / "videos", tmp_path / "videos")


INFOS = {
    "a list": b"[]",
    "no total_episodes": b'{"codebase_version": "v3.0", "features": {}, "fps": 10}',
    "not utf-8": b'{"codebase_version": "v3.0\xff"}',
    "nested deeply": b"[" * 100_000,
    "negative": b'{"codebase_version": "v3.0", "features": {}, "fps": 10, "total_episodes": -1}',
    "no features": b'{"codebase_version": "v3.0", "features": [], "fps": 10, "total_episodes": 1}',
    "no frames a second": b'{"codebase_version": "v3.0", "features": {}, "fps": 0, "total_episodes": 1}',
}


@pytest.mark.parametrize("kind", INFOS)
def test_a29_a_broken_description_of_a_lerobot_dataset_is_refused(kind, images):
    (images / "meta/info.json").write_bytes(INFOS[kind])
    for read in (lerobot.count_episodes, lambda folder: lerobot.read_lerobot(folder, KEYS)):
        with pytest.raises(DemonstrationError, match=r"info\.json"):
            read(images)


def test_a29_more_episodes_than_there_are_is_refused(images):
    rewrite_json(images / "meta/info.json", lambda info: info.update(total_episodes=9))
    with pytest.raises(DemonstrationError, match="holds 2 episodes, 9 are wanted"):
        lerobot.read_lerobot(images, KEYS)


@pytest.mark.parametrize(
    "video_path",
    ["/etc/{video_key}", "../../{video_key}.mp4", "{video_key.__class__.__init__.__globals__}", "{0:>99999999999}", 5],
)
def test_b7_a_video_path_is_compared_and_never_filled_in(video_path, videos):
    rewrite_json(videos / "meta/info.json", lambda info: info.update(video_path=video_path))
    with pytest.raises(DemonstrationError, match="video_path"):
        lerobot.read_lerobot(videos, KEYS)


def test_b7_a_playlist_named_mp4_is_not_given_to_ffmpeg(videos, secret):
    (path,) = videos.rglob("*.mp4")
    path.write_text(f"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nfile://{secret}\n#EXT-X-ENDLIST\n")
    with pytest.raises(DemonstrationError, match="not an mp4 file"):
        lerobot.read_lerobot(videos, KEYS)


@pytest.mark.parametrize("name", ["meta/info.json", "data/chunk-000/file-000.parquet", "data", "extra"])
def test_b7_links_out_of_a_lerobot_dataset_are_refused(name, images, tmp_path):
    away = tmp_path / "away"
    if (images / name).exists():
        (images / name).rename(away)
    else:
        away.mkdir()
    (images / name).symlink_to(away)
    with pytest.raises(DemonstrationError, match="is a link out of"):
        lerobot.read_lerobot(images, KEYS)


def test_b7_a_pipe_in_a_dataset_is_refused_and_not_waited_for(images):
    os.mkfifo(images / "data/chunk-000/file-001.parquet")
    with pytest.raises(DemonstrationError, match="is no plain file"):
        lerobot.read_lerobot(images, KEYS)


@pytest.mark.parametrize("name", ["../elsewhere/trajectory.h5", "/etc/passwd", "link/trajectory.h5"])
def test_b7_a_manifest_names_files_in_its_folder_alone(name, tmp_path):
    folder, elsewhere = tmp_path / "set", tmp_path / "elsewhere"
    folder.mkdir()
    shutil.copytree(SAMPLE, elsewhere)
    (folder / "link").symlink_to(elsewhere)
    (folder / "manifest.json").write_text(json.dumps({"schema": "manifeel-demonstrations-1", "files": {name: {}}}))
    (problem,) = validate(folder)
    assert "names files in its own folder" in problem


# ------------------------------------------------------------------ A29, B1: zarr


@pytest.fixture(scope="module")
def exported(tmp_path_factory) -> Path:
    pytest.importorskip("zarr")
    return export(Args(SAMPLE / "trajectory.h5", "zarr", tmp_path_factory.mktemp("zarr") / "store"))


@pytest.fixture
def store(exported, tmp_path) -> Path:
    return shutil.copytree(exported, tmp_path / "store")


class Gadget:
    """Unpickled, it runs a command."""

    def __reduce__(self):
        return os.system, ("touch executed",)


@pytest.mark.parametrize("name", ["meta/episode_ends", "data/action", "data/wrist"])
@pytest.mark.parametrize(
    "change",
    [
        {"filters": [{"id": "pickle", "protocol": 5}]},
        {"compressor": {"id": "pickle"}},
        {"dtype": "|O"},
        {"dtype": "|O", "filters": [{"id": "pickle", "protocol": 5}]},
        {"dtype": "|V99999999"},
        {"dtype": [["a", "|O"]]},
        {"shape": [2**40, 6]},
        {"shape": [2**39, 2**39]},
        {"chunks": [2**39, 6]},
        {"chunks": [0, 6]},
        {"shape": [-1, 6]},
        {"shape": "text"},
    ],
    ids=str,
)
def test_b1_an_array_that_could_run_code_or_fill_memory_is_refused(name, change, store, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rewrite_json(store / name / ".zarray", lambda about: about.update(change))
    for chunk in (store / name).glob("[0-9]*"):
        if chunk.is_file():
            chunk.write_bytes(pickle.dumps(Gadget()))
    with pytest.raises(DemonstrationError):
        diffusion_policy_zarr.read_zarr(store, KEYS)
    if not name.endswith("wrist"):
        with pytest.raises(DemonstrationError):
            diffusion_policy_zarr.count_episodes(store)
    assert not (tmp_path / "executed").exists()


def test_b1_consolidated_metadata_do_not_stand_in_for_what_was_checked(store, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    about = {str(path.relative_to(store)): json.loads(path.read_text()) for path in store.rglob(".z*")}
    about["data/action/.zarray"] |= {"dtype": "|O", "filters": [{"id": "pickle"}]}
    (store / ".zmetadata").write_text(json.dumps({"zarr_consolidated_format": 1, "metadata": about}))
    assert len(diffusion_policy_zarr.read_zarr(store, KEYS)) == 2
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize("ends", [[-1], [10**12], [5, 3], [0, 4], [4, 4], [2.5], [[1]], [float("nan")]], ids=str)
def test_a29_ends_of_episodes_rise_within_the_steps(ends, store):
    import zarr

    shutil.rmtree(store / "meta/episode_ends")
    zarr.open_group(str(store), mode="r+").create_array("meta/episode_ends", data=np.array(ends))
    for read in (diffusion_policy_zarr.count_episodes, lambda folder: diffusion_policy_zarr.read_zarr(folder, KEYS)):
        with pytest.raises(DemonstrationError, match="must be rising whole numbers"):
            read(store)


@pytest.mark.parametrize("wanted", [-1, 0, 3])
def test_a29_as_many_episodes_as_there_are_can_be_read(wanted, store, images):
    with pytest.raises(DemonstrationError, match="episodes"):
        diffusion_policy_zarr.read_zarr(store, KEYS, wanted)
    with pytest.raises(DemonstrationError, match="episodes"):
        lerobot.read_lerobot(images, KEYS, wanted)


@pytest.mark.parametrize("name", ["data/action/0.0", "data/wrist", "meta"])
def test_links_out_of_a_store_are_refused(name, store, tmp_path):
    (store / name).rename(tmp_path / "away")
    (store / name).symlink_to(tmp_path / "away")
    with pytest.raises(DemonstrationError, match="is a link out of"):
        diffusion_policy_zarr.read_zarr(store, KEYS)


# ------------------------------------------------------------------ B2: weights that others have published


class CosineSchedule:
    """Stands for a scheduler of the authors: pickled whole, and not to be had here."""

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
    """A file as torch writes it, around a pickle of one's own."""
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


def test_readers_raise_errors_of_this_package_for_folders_and_missing_files(tmp_path):
    for read in (
        lambda: read_demonstrations(tmp_path / "no.h5", KEYS),
        lambda: read_demonstrations(tmp_path, KEYS),
        lambda: diffusion_policy_zarr.read_zarr(tmp_path, KEYS),
        lambda: lerobot.read_lerobot(tmp_path, KEYS),
        lambda: read_tensors(tmp_path),
        lambda: validate(tmp_path),
    ):
        with pytest.raises(ManifeelError):
            read()
