"""LeRobot datasets, two written by lerobot 0.4.4 itself: one with images, one with videos."""

import json
import shutil
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest

from manifeel_ms3.demonstrations import DemonstrationError
from manifeel_ms3.demonstrations.formats.lerobot import count_episodes, feature_name, is_lerobot, read_lerobot
from tests.sample import KEYS

pytest.importorskip("pyarrow")
import pyarrow.parquet as pq

DATASETS = Path(__file__).with_name("lerobot")
LENGTHS = (4, 3)


def test_features_have_their_names():
    assert [feature_name(key) for key in (*KEYS, "sensor_data/tactile_left/rgb")] == [
        "observation.images.wrist",
        "observation.tactile.right.force_field",
        "observation.state",
        "observation.images.tactile_left",
    ]


@pytest.mark.parametrize("kind", ["images", "videos"])  # of version 0.1.0: force fields have another name there
def test_numbers_are_those_that_were_written(kind):
    folder = DATASETS / kind
    assert is_lerobot(folder)
    assert count_episodes(folder) == 2
    for e, episode in enumerate(read_lerobot(folder, KEYS, 2)):
        steps = np.arange(LENGTHS[e])
        assert np.allclose(episode["actions"], (0.1 * steps - e)[:, None].repeat(6, 1))
        seen = np.append(steps, steps[-1])  # the last observation twice
        assert np.allclose(episode["extra/tcp_pose"], np.arange(7) + (10 * e + seen)[:, None])
        field = episode["sensor_data/tactile_right/force_field"]
        assert field.shape == (LENGTHS[e] + 1, 10, 14, 3)
        assert np.allclose(field[:, 3, 2, 1], 10 * e + seen)


def test_images_are_bit_for_bit():
    y, x = np.mgrid[:24, :32]
    for e, episode in enumerate(read_lerobot(DATASETS / "images", KEYS[:1], 2)):
        for t in range(LENGTHS[e]):
            written = [(x * 7 + t * 9) % 256, (y * 9 + e * 40) % 256, np.full_like(x, (50 * e + t) % 256)]
            assert np.array_equal(episode[KEYS[0]][t], np.stack(written, -1))


def test_videos_show_each_episodes_frames():
    for e, episode in enumerate(read_lerobot(DATASETS / "videos", KEYS[:1], 2)):
        frames = episode[KEYS[0]]
        assert frames.shape == (LENGTHS[e] + 1, 96, 96, 3)
        for t in range(LENGTHS[e]):  # compression loses a little
            assert np.abs(frames[t].mean((0, 1)) - [60 * t + 20, 200 - 50 * t, 90 * e + 30]).max() < 12


def test_a_video_file_is_decoded_once(monkeypatch):
    opened = []
    get_reader = imageio.get_reader
    monkeypatch.setattr(imageio, "get_reader", lambda path: opened.append(path) or get_reader(path))
    assert len(list(read_lerobot(DATASETS / "videos", KEYS[:1], 2))) == 2
    assert len(opened) == len(set(opened)) == 1


def test_progress_is_reported_and_fewer_can_be_read():
    seen = []
    assert len(list(read_lerobot(DATASETS / "images", KEYS, 1, lambda indices: seen.append(len(indices)) or indices))) == 1
    assert seen == [1]


@pytest.fixture
def copy(tmp_path):
    shutil.copytree(DATASETS / "images", tmp_path / "dataset")
    return tmp_path / "dataset"


def split(folder: Path) -> None:
    """Give the second episode a data file of its own, and turn the rows of the first around."""
    data, episodes = folder / "data/chunk-000/file-000.parquet", folder / "meta/episodes/chunk-000/file-000.parquet"
    table, entries = pq.read_table(data), pq.read_table(episodes)
    first = LENGTHS[0]
    pq.write_table(table.slice(first), data.with_name("file-001.parquet"))
    pq.write_table(table.take(list(range(first))[::-1]), data)
    place = entries.schema.get_field_index("data/file_index")
    pq.write_table(entries.set_column(place, "data/file_index", [[0, 1]]), episodes)


def test_each_data_file_is_read_when_its_episode_is(copy):
    expected = list(read_lerobot(copy, KEYS))
    split(copy)
    for episode, original in zip(read_lerobot(copy, KEYS), expected, strict=True):
        assert all(np.array_equal(episode[name], values) for name, values in original.items())
    (copy / "data/chunk-000/file-001.parquet").write_bytes(b"PAR1 no more")
    assert len(list(read_lerobot(copy, KEYS, 1))) == 1
    with pytest.raises(DemonstrationError, match=r"in data/chunk-000/file-001\.parquet, the data cannot be read"):
        list(read_lerobot(copy, KEYS, 2))


def test_rows_that_a_data_file_lacks_are_said(copy):
    data = copy / "data/chunk-000/file-000.parquet"
    pq.write_table(pq.read_table(data).slice(0, 6), data)
    with pytest.raises(DemonstrationError, match=r"episode 1 has 3 frames from 4 on, of which file-000\.parquet holds 2"):
        list(read_lerobot(copy, KEYS))


def test_a_state_of_joint_positions_is_no_pose(copy, caplog):
    info = json.loads((copy / "meta/info.json").read_text())
    state = info["features"]["observation.state"]
    joints = [f"joint_{i}" for i in range(7)]
    for names in (joints, dict(motors=joints)):
        state["names"] = names
        (copy / "meta/info.json").write_text(json.dumps(info))
        with pytest.raises(DemonstrationError, match=r"observation\.state holds \['joint_0'.* take the pose of the tool"):
            list(read_lerobot(copy, KEYS))
    state["names"] = dict(axes=["x", "y", "z", "qw", "qx", "qy", "qz"])
    (copy / "meta/info.json").write_text(json.dumps(info | dict(fps=30)))
    assert len(list(read_lerobot(copy, KEYS))) == 2
    assert "has 30 frames per second; tasks here act 10 times per second" in caplog.text


def test_what_is_missing_or_broken_is_named(copy):
    with pytest.raises(DemonstrationError, match=r"lacks \['observation.images.front'\]; it holds .*wrist"):
        list(read_lerobot(copy, ["sensor_data/front/rgb"], 1))
    info = json.loads((copy / "meta/info.json").read_text())
    (copy / "data/chunk-000/file-000.parquet").write_bytes(b"PAR1 no more")
    with pytest.raises(DemonstrationError, match="data cannot be read"):
        list(read_lerobot(copy, KEYS, 1))
    (copy / "meta/info.json").write_text(json.dumps(info | dict(codebase_version="v2.1")))
    with pytest.raises(DemonstrationError, match="convert_dataset_v21_to_v30"):
        list(read_lerobot(copy, KEYS, 1))
    (copy / "meta/info.json").write_text("{")
    with pytest.raises(DemonstrationError, match=r"info\.json is not the description of a LeRobot dataset"):
        list(read_lerobot(copy, KEYS, 1))
