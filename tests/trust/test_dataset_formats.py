"""LeRobot and zarr datasets of strangers: nothing is run, and nothing outside of them is read."""

import json
import os
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest

from baselines.common.checkpoint import read_tensors
from manifeel_ms3.demonstrations import DemonstrationError, read_demonstrations
from manifeel_ms3.demonstrations.export import Args
from manifeel_ms3.demonstrations.export import main as export
from manifeel_ms3.demonstrations.formats import diffusion_policy_zarr, lerobot
from manifeel_ms3.demonstrations.validate import validate
from manifeel_ms3.errors import ManifeelError
from tests.sample import KEYS

from .files_of_strangers import LEROBOT, SAMPLE, Gadget, rewrite_json

# ------------------------------------------------------------------ LeRobot


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
    for read in (lerobot.count_episodes, lambda folder: list(lerobot.read_lerobot(folder, KEYS))):
        with pytest.raises(DemonstrationError, match=r"info\.json"):
            read(images)


def test_a29_more_episodes_than_there_are_is_refused(images):
    rewrite_json(images / "meta/info.json", lambda info: info.update(total_episodes=9))
    with pytest.raises(DemonstrationError, match="holds 2 episodes, 9 are wanted"):
        list(lerobot.read_lerobot(images, KEYS))


@pytest.mark.parametrize(
    "video_path",
    ["/etc/{video_key}", "../../{video_key}.mp4", "{video_key.__class__.__init__.__globals__}", "{0:>99999999999}", 5],
)
def test_b7_a_video_path_is_compared_and_never_filled_in(video_path, videos):
    rewrite_json(videos / "meta/info.json", lambda info: info.update(video_path=video_path))
    with pytest.raises(DemonstrationError, match=r"\$\.video_path: .* is not one of"):
        list(lerobot.read_lerobot(videos, KEYS))


def test_b7_a_playlist_named_mp4_is_not_given_to_ffmpeg(videos, secret):
    (path,) = videos.rglob("*.mp4")
    path.write_text(f"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nfile://{secret}\n#EXT-X-ENDLIST\n")
    with pytest.raises(DemonstrationError, match="not an mp4 file"):
        list(lerobot.read_lerobot(videos, KEYS))


@pytest.mark.parametrize("name", ["meta/info.json", "data/chunk-000/file-000.parquet", "data", "extra"])
def test_b7_links_out_of_a_lerobot_dataset_are_refused(name, images, tmp_path):
    away = tmp_path / "away"
    if (images / name).exists():
        (images / name).rename(away)
    else:
        away.mkdir()
    (images / name).symlink_to(away)
    with pytest.raises(DemonstrationError, match="is a link out of"):
        list(lerobot.read_lerobot(images, KEYS))


def test_b7_a_pipe_in_a_dataset_is_refused_and_not_waited_for(images):
    os.mkfifo(images / "data/chunk-000/file-001.parquet")
    with pytest.raises(DemonstrationError, match="is no plain file"):
        list(lerobot.read_lerobot(images, KEYS))


@pytest.mark.parametrize("name", ["../elsewhere/trajectory.h5", "/etc/passwd", "link/trajectory.h5"])
def test_b7_a_manifest_names_files_in_its_folder_alone(name, tmp_path):
    folder, elsewhere = tmp_path / "set", tmp_path / "elsewhere"
    folder.mkdir()
    shutil.copytree(SAMPLE.parent, elsewhere)
    (folder / "link").symlink_to(elsewhere)
    (folder / "manifest.json").write_text(json.dumps({"schema": "manifeel-demonstrations-1", "files": {name: {}}}))
    (problem,) = validate(folder)
    assert "only names files in its own folder" in problem


# ------------------------------------------------------------------ zarr


@pytest.fixture(scope="module")
def exported(tmp_path_factory) -> Path:
    pytest.importorskip("zarr")
    return export(Args(SAMPLE, "zarr", tmp_path_factory.mktemp("zarr") / "store"))


@pytest.fixture
def store(exported, tmp_path) -> Path:
    return shutil.copytree(exported, tmp_path / "store")


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
        list(diffusion_policy_zarr.read_zarr(store, KEYS))
    if not name.endswith("wrist"):
        with pytest.raises(DemonstrationError):
            diffusion_policy_zarr.count_episodes(store)
    assert not (tmp_path / "executed").exists()


def test_b1_consolidated_metadata_do_not_stand_in_for_what_was_checked(store, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    about = {str(path.relative_to(store)): json.loads(path.read_text()) for path in store.rglob(".z*")}
    about["data/action/.zarray"] |= {"dtype": "|O", "filters": [{"id": "pickle"}]}
    (store / ".zmetadata").write_text(json.dumps({"zarr_consolidated_format": 1, "metadata": about}))
    assert len(list(diffusion_policy_zarr.read_zarr(store, KEYS))) == 2
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize("ends", [[-1], [10**12], [5, 3], [0, 4], [4, 4], [2.5], [[1]], [float("nan")]], ids=str)
def test_a29_ends_of_episodes_rise_within_the_steps(ends, store):
    import zarr

    shutil.rmtree(store / "meta/episode_ends")
    zarr.open_group(str(store), mode="r+").create_array("meta/episode_ends", data=np.array(ends))
    for read in (diffusion_policy_zarr.count_episodes, lambda folder: list(diffusion_policy_zarr.read_zarr(folder, KEYS))):
        with pytest.raises(DemonstrationError, match="must be rising whole numbers"):
            read(store)


@pytest.mark.parametrize("wanted", [-1, 0, 3])
def test_a29_as_many_episodes_as_there_are_can_be_read(wanted, store, images):
    with pytest.raises(DemonstrationError, match="episodes"):
        list(diffusion_policy_zarr.read_zarr(store, KEYS, wanted))
    with pytest.raises(DemonstrationError, match="episodes"):
        list(lerobot.read_lerobot(images, KEYS, wanted))


@pytest.mark.parametrize("name", ["data/action/0.0", "data/wrist", "meta"])
def test_links_out_of_a_store_are_refused(name, store, tmp_path):
    (store / name).rename(tmp_path / "away")
    (store / name).symlink_to(tmp_path / "away")
    with pytest.raises(DemonstrationError, match="is a link out of"):
        list(diffusion_policy_zarr.read_zarr(store, KEYS))


def test_readers_raise_errors_of_this_package_for_folders_and_missing_files(tmp_path):
    for read in (
        lambda: read_demonstrations(tmp_path / "no.h5", KEYS),
        lambda: read_demonstrations(tmp_path, KEYS),
        lambda: list(diffusion_policy_zarr.read_zarr(tmp_path, KEYS)),
        lambda: list(lerobot.read_lerobot(tmp_path, KEYS)),
        lambda: read_tensors(tmp_path),
        lambda: validate(tmp_path),
    ):
        with pytest.raises(ManifeelError):
            read()
