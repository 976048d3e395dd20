"""What is exported reads back as what was recorded."""

import importlib.util
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from baselines.common.dataset import read_episodes, recorded_env_kwargs, recorded_task
from baselines.common.observation import observation_spec
from manifeel_ms3.demonstrations import DemonstrationError, export, read_demonstrations, replay, view
from manifeel_ms3.demonstrations.formats import MANISKILL_H5, diffusion_policy_zarr, format_of, lerobot
from manifeel_ms3.demonstrations.formats.lerobot_statistics import QUANTILES, episode_statistics
from manifeel_ms3.demonstrations.formats.maniskill_h5 import observation_keys, open_trajectories, read_header
from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.tasks.registry import task_spec
from tests.sample import KEYS, observed_sample, states_sample
from tests.tasks_and_marks import PEG
from tests.trajectories import changed_copy, renumbered

SAMPLE = observed_sample(PEG)


def exported(kind: export.Format, folder: Path) -> Path:
    if kind != "npz":
        pytest.importorskip("pyarrow" if kind == "lerobot" else "zarr")
    return export.main(export.Args(SAMPLE, kind, folder / kind))


def require_same(read: list[dict[str, np.ndarray]], last_is_repeated: bool) -> None:
    recorded = read_demonstrations(SAMPLE, KEYS)
    assert len(read) == len(recorded)
    for episode, original in zip(read, recorded, strict=True):
        assert np.array_equal(episode["actions"], original["actions"])
        for key in KEYS:
            expected = original[key].copy()
            if last_is_repeated:  # the format holds no observation after the last action
                expected[-1] = expected[-2]
            assert episode[key].dtype == expected.dtype
            assert np.array_equal(episode[key], expected), key


def test_the_command_that_trains_on_an_export_asks_for_what_was_recorded():
    recorded = read_header(SAMPLE)["env_info"]["env_kwargs"]
    said = export.next_step(export.Args(SAMPLE, "lerobot", Path("folder")), Path("folder"))
    sensing = f"--env-id {PEG} --obs-mode {recorded['obs_mode']} --cameras {' '.join(recorded['cameras'])}"
    assert f"`manifeel train diffusion_policy cpu --demo-path folder {sensing}`" in said


def test_what_can_be_exported_is_found():
    assert sorted(observation_keys(SAMPLE)) == sorted(KEYS)
    with pytest.raises(DemonstrationError, match="states and actions alone"):
        observation_keys(states_sample(PEG))


def test_lerobot(tmp_path):
    folder = exported("lerobot", tmp_path)
    require_same(list(lerobot.read_lerobot(folder, KEYS, 2)), last_is_repeated=True)
    stats = json.loads((folder / "meta/stats.json").read_text())
    poses = np.concatenate([episode["extra/tcp_pose"][:-1] for episode in read_demonstrations(SAMPLE, KEYS)])
    assert np.allclose(stats["observation.state"]["mean"], poses.mean(0), atol=1e-6)
    assert np.allclose(stats["observation.state"]["std"], poses.std(0), atol=1e-6)
    one, other = (episode["extra/tcp_pose"][:-1] for episode in read_demonstrations(SAMPLE, KEYS))
    share = len(one) / len(poses)
    for name, quantile in dict(q01=0.01, q10=0.1, q50=0.5, q90=0.9, q99=0.99).items():  # means over episodes, as in lerobot
        expected = share * np.quantile(one, quantile, axis=0) + (1 - share) * np.quantile(other, quantile, axis=0)
        assert np.allclose(stats["observation.state"][name], expected, atol=1e-6)
    assert np.allclose([stats["observation.state"][name] for name in ("min", "max")], [poses.min(0), poses.max(0)])
    assert stats["observation.state"]["count"] == [len(poses)]
    images = np.concatenate([episode[KEYS[0]][:-1] for episode in read_demonstrations(SAMPLE, KEYS)]) / 255
    assert np.allclose(np.ravel(stats["observation.images.wrist"]["mean"]), images.mean((0, 1, 2)), atol=1e-6)
    assert np.allclose(np.ravel(stats["observation.images.wrist"]["std"]), images.std((0, 1, 2)), atol=1e-6)


def test_statistics_of_images_are_those_of_all_their_pixels():
    images = np.random.default_rng(0).integers(0, 200, (3, 5, 7, 3), np.uint8)
    found, pixels = episode_statistics(images), images.reshape(-1, 3) / 255
    assert found["count"] == [3]
    for name in ("min", "max", "mean", "std"):
        assert np.shape(found[name]) == (3, 1, 1)
        assert np.allclose(np.ravel(found[name]), getattr(pixels, name)(0), atol=1e-12)
    for name, quantile in QUANTILES.items():
        assert np.allclose(np.ravel(found[name]), np.quantile(pixels, quantile, axis=0), atol=1e-12)


@pytest.mark.parametrize("kind", ["lerobot", "zarr"])
@pytest.mark.parametrize(("key", "said"), [("actions", r"\(5,\) as 'actions?'"), ("obs/extra/tcp_pose", r"\(6,\) as")])
def test_episodes_of_two_forms_are_refused(kind, key, said, tmp_path):
    pytest.importorskip("pyarrow" if kind == "lerobot" else "zarr")
    other = changed_copy(SAMPLE, tmp_path, key, lambda values: values[:, 1:])
    with pytest.raises(DemonstrationError, match=rf"episode 1, counted from 0, has float32 {said}.* and the first episode"):
        export.main(export.Args(other, kind, tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_what_an_export_leaves_out_is_said(tmp_path, caplog):
    caplog.set_level("INFO")
    exported("npz", tmp_path)
    assert "left out: agent/qpos, agent/qvel, " in caplog.text


def test_no_command_is_named_that_could_not_train(tmp_path):
    other = changed_copy(SAMPLE, tmp_path, "rewards", np.negative, obs_mode="state_dict")
    assert export.next_step(export.Args(other, "lerobot", tmp_path), tmp_path).endswith("is a data set of the format lerobot")


def test_episodes_are_found_by_their_numbers(tmp_path):
    other = renumbered(SAMPLE, tmp_path)
    assert sorted(observation_keys(other)) == sorted(KEYS)
    for episode, original in zip(read_demonstrations(other, KEYS), read_demonstrations(SAMPLE, KEYS), strict=True):
        assert all(np.array_equal(episode[name], values) for name, values in original.items())


def test_an_episode_that_the_json_names_and_the_file_lacks_is_said(tmp_path):
    other = renumbered(SAMPLE, tmp_path)
    other.with_suffix(".json").write_bytes(SAMPLE.with_suffix(".json").read_bytes())
    with pytest.raises(DemonstrationError, match="lacks traj_1, which its json names"):
        read_demonstrations(other, KEYS)


def test_a_json_of_another_recording_is_said(tmp_path):
    copy = Path(shutil.copy(SAMPLE, tmp_path))
    shutil.copy(observed_sample("ManiFeel-USBInsertion-v1").with_suffix(".json"), copy.with_suffix(".json"))
    with pytest.raises(DemonstrationError, match=r"actions in traj_0, and its json says \d+: the two files are not of one"):
        export.main(export.Args(copy, "npz", tmp_path / "out"))
    assert not (tmp_path / "out").exists()
    with pytest.raises(DemonstrationError, match="the two files are not of one recording"):
        replay.replay(copy, 1)


def test_a_file_without_episodes_has_nothing_to_export(tmp_path):
    other = renumbered(SAMPLE, tmp_path)
    header = json.loads(other.with_suffix(".json").read_text())
    other.with_suffix(".json").write_text(json.dumps(header | dict(episodes=[])))
    with pytest.raises(DemonstrationError, match="holds no episode"):
        observation_keys(other)
    with pytest.raises(DemonstrationError, match="holds no episode yet; record some"):
        view.read_streams(other, 0)


def test_a_lerobot_dataset_keeps_the_arguments_of_the_task(tmp_path):
    folder = exported("lerobot", tmp_path)
    assert recorded_env_kwargs([folder]) == recorded_env_kwargs([SAMPLE])
    assert recorded_task([folder]) == PEG
    with pytest.raises(DemonstrationError, match="of ManiFeel-PegInsertion-v1, not of ManiFeel-BallSorting-v1; ask for"):
        list(lerobot.read_lerobot(folder, KEYS, env_id="ManiFeel-BallSorting-v1"))
    origin = folder / "meta/manifeel.json"
    origin.write_text(json.dumps(dict(env_id=PEG, env_kwargs=dict(fit="tight"))))
    with pytest.raises(DemonstrationError, match=r"with fit='tight'.*train on files"):
        recorded_env_kwargs([folder, SAMPLE])
    origin.write_text(json.dumps(dict(env_id=PEG)))
    with pytest.raises(DemonstrationError, match=r"env_kwargs.*export the dataset again"):
        recorded_env_kwargs([folder])
    origin.unlink()  # a dataset of another source
    assert recorded_env_kwargs([folder]) == {}


@pytest.mark.parametrize(("given", "word"), [({}, "lift it"), (dict(goal="bowls"), "orange bowl")])
def test_the_sentence_of_a_lerobot_dataset_is_that_of_the_recorded_goal(tmp_path, given, word):
    pytest.importorskip("pyarrow")
    import pyarrow.parquet as pq

    sample = observed_sample("ManiFeel-BallSorting-v1")
    recorded = Path(shutil.copy(sample, tmp_path / "trajectory.h5"))
    header = json.loads(sample.with_suffix(".json").read_text())
    header["env_info"]["env_kwargs"] |= given
    recorded.with_suffix(".json").write_text(json.dumps(header))
    folder = export.main(export.Args(recorded, "lerobot", tmp_path / "lerobot"))
    (sentence,) = pq.read_table(folder / "meta/episodes").column("tasks").to_pylist()[0]
    assert word in sentence


def test_a_lerobot_dataset_says_what_it_is(tmp_path):
    folder = exported("lerobot", tmp_path)
    import pyarrow.parquet as pq

    sentence = task_spec(PEG).instruction
    assert pq.read_table(folder / "meta/tasks.parquet").to_pylist() == [{"task_index": 0, "__index_level_0__": sentence}]
    assert pq.read_table(folder / "meta/episodes").column("tasks").to_pylist() == [[sentence]] * 2
    features = json.loads((folder / "meta/info.json").read_text())["features"]
    assert features["action"]["names"] == ["x", "y", "z", "roll", "pitch", "yaw"]
    assert features["observation.state"]["names"] == ["x", "y", "z", "qw", "qx", "qy", "qz"]
    assert features["observation.tactile.right.force_field"]["names"] == ["rows", "columns", "force"]
    card = (folder / "README.md").read_text()
    assert card.startswith("---\nlicense: apache-2.0\n")
    assert all(f"| `{name}` |" in card for name in features)
    assert sentence in card


def test_a_lerobot_dataset_holds_the_outcome_of_each_action(tmp_path):
    folder = exported("lerobot", tmp_path)
    import pyarrow.parquet as pq

    with open_trajectories(SAMPLE) as file:
        for e in range(2):
            table = pq.read_table(folder / f"data/chunk-000/file-{e:03d}.parquet")
            assert table["next.success"].to_pylist() == file[f"traj_{e}/success"][()].tolist()
            assert table["next.done"].to_pylist() == [False] * (table.num_rows - 1) + [True]
            assert np.allclose(table["next.reward"].to_pylist(), file[f"traj_{e}/rewards"][()])


def test_a_lerobot_dataset_counts_its_frames_and_tells_their_times(tmp_path):
    folder = exported("lerobot", tmp_path)
    import pyarrow.parquet as pq

    lengths = [len(episode["actions"]) for episode in read_demonstrations(SAMPLE, [])]
    info = json.loads((folder / "meta/info.json").read_text())
    assert (info["fps"], info["total_episodes"], info["total_frames"]) == (10, 2, sum(lengths))
    entries, begin = pq.read_table(folder / "meta/episodes").to_pylist(), 0
    for e, (entry, length) in enumerate(zip(entries, lengths, strict=True)):
        table = pq.read_table(folder / f"data/chunk-000/file-{e:03d}.parquet")
        assert np.allclose(table["timestamp"].to_pylist(), np.arange(length) / 10)  # s
        assert table["frame_index"].to_pylist() == list(range(length))
        assert table["episode_index"].to_pylist() == [e] * length
        assert table["index"].to_pylist() == list(range(begin, begin + length))
        assert (entry["episode_index"], entry["length"]) == (e, length)
        assert (entry["dataset_from_index"], entry["dataset_to_index"]) == (begin, begin + length)
        assert (entry["data/chunk_index"], entry["data/file_index"]) == (0, e)
        begin += length


def test_a_lerobot_dataset_has_the_control_rate_of_its_recording(tmp_path):
    pytest.importorskip("pyarrow")
    recorded = changed_copy(SAMPLE, tmp_path, "rewards", np.negative, sim_config=dict(control_freq=20))
    folder = export.main(export.Args(recorded, "lerobot", tmp_path / "videos", videos=True))
    import imageio.v2 as imageio
    import pyarrow.parquet as pq

    assert json.loads((folder / "meta/info.json").read_text())["fps"] == 20
    table = pq.read_table(folder / "data/chunk-000/file-000.parquet")
    assert np.allclose(table["timestamp"].to_pylist(), np.arange(table.num_rows) / 20)  # s
    entry = pq.read_table(folder / "meta/episodes").to_pylist()[1]
    name = "videos/observation.images.wrist"
    assert entry[f"{name}/to_timestamp"] == pytest.approx(entry["length"] / 20)
    with imageio.get_reader(folder / name / "chunk-000/file-001.mp4") as video:
        assert (video.get_meta_data()["fps"], video.count_frames()) == (20, entry["length"])
    last = list(lerobot.read_lerobot(folder, KEYS))[1]
    assert len(last["actions"]) == entry["length"]


def test_the_cameras_of_a_lerobot_dataset_can_be_videos(tmp_path):
    pytest.importorskip("pyarrow")
    folder = export.main(export.Args(SAMPLE, "lerobot", tmp_path / "videos", videos=True))
    import imageio.v2 as imageio
    import pyarrow.parquet as pq

    camera, *rest = KEYS
    name = "observation.images.wrist"
    for e, entry in enumerate(pq.read_table(folder / "meta/episodes").to_pylist()):
        assert (entry[f"videos/{name}/from_timestamp"], entry[f"videos/{name}/to_timestamp"]) == (0.0, entry["length"] / 10)
        with imageio.get_reader(folder / f"videos/{name}/chunk-000/file-{e:03d}.mp4") as video:
            assert (video.get_meta_data()["fps"], video.count_frames()) == (10, entry["length"])
    recorded, read = read_demonstrations(SAMPLE, KEYS), lerobot.read_lerobot(folder, KEYS)
    for episode, original in zip(read, recorded, strict=True):
        assert np.abs(episode[camera][:-1].astype(float) - original[camera][:-1]).mean() < 6  # H.264 halves colours
        assert all(np.array_equal(episode[key][:-1], original[key][:-1]) for key in rest)
    with pytest.raises(InvalidArgumentError, match="--videos is for --to lerobot"):
        export.main(export.Args(SAMPLE, "npz", tmp_path / "npz", videos=True))


@pytest.mark.skipif(importlib.util.find_spec("lerobot") is None, reason="lerobot is not installed")
def test_lerobots_own_reader_takes_it(tmp_path):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset("local/peg", root=exported("lerobot", tmp_path))
    recorded = read_demonstrations(SAMPLE, KEYS)
    assert dataset.num_episodes == 2
    assert len(dataset) == sum(len(episode["actions"]) for episode in recorded)
    frame = dataset[7]
    assert np.allclose(frame["action"], recorded[0]["actions"][7])
    assert np.allclose(frame["observation.images.wrist"].permute(1, 2, 0) * 255, recorded[0][KEYS[0]][7], atol=1e-3)
    assert np.allclose(frame["observation.tactile.right.force_field"], recorded[0][KEYS[1]][7])
    assert frame["task"] == task_spec(PEG).instruction
    assert frame["next.success"].dtype == torch.bool


def test_zarr_of_the_papers_layout(tmp_path):
    folder = exported("zarr", tmp_path)
    assert diffusion_policy_zarr.is_zarr(folder)
    assert (folder / "data/wrist/.zarray").is_file()  # format 2, which the paper's code reads
    assert {path.name for path in (folder / "data").iterdir() if path.is_dir()} == {
        *("wrist", "tactile_force_field_right", "state", "action")
    }
    require_same(list(diffusion_policy_zarr.read_zarr(folder, KEYS, 2)), last_is_repeated=True)
    import zarr

    poses = np.concatenate([episode["extra/tcp_pose"][:-1] for episode in read_demonstrations(SAMPLE, KEYS)])
    x, y, z, qw, qx, qy, qz = poses.T
    assert np.array_equal(zarr.open_array(str(folder / "data/state"), mode="r")[:], np.stack([x, y, z, qx, qy, qz, qw], 1))


def test_images_of_touch_lie_as_in_the_papers_data():
    key = "sensor_data/tactile_right/rgb"
    assert diffusion_policy_zarr.array_name(key) == "right_tactile_camera_taxim"
    images = np.random.default_rng(0).integers(0, 256, (3, 240, 320, 3), np.uint8)
    theirs = diffusion_policy_zarr._to_paper(key, images)
    assert theirs.shape == (3, 320, 240, 3)
    assert theirs.dtype == np.float32
    assert theirs.max() <= 1
    assert np.array_equal(diffusion_policy_zarr._from_paper(key, theirs), images)
    assert np.allclose(255 * theirs[:, 0], images[:, ::-1, 0])  # turned clockwise: the first column becomes the first row


def test_npz(tmp_path):
    folder = exported("npz", tmp_path)
    read = [{k.replace(".", "/"): v for k, v in np.load(file).items()} for file in sorted(folder.glob("*.npz"))]
    require_same(read, last_is_repeated=False)
    about = json.loads((folder / "episodes.json").read_text())
    assert (about["env_id"], about["revision"]) == (PEG, task_spec(PEG).revision)
    seeds = [episode["episode_seed"] for episode in read_header(SAMPLE)["episodes"]]
    assert about["episodes"] == [dict(file=f"episode_{i:05d}.npz", episode_seed=seed) for i, seed in enumerate(seeds)]


def test_npz_holds_the_arrays_of_an_episode_alone(tmp_path, monkeypatch):
    """NumPy 1.26 saves every keyword as an array."""
    keywords = []
    monkeypatch.setattr(export.np, "savez_compressed", lambda file, **arrays: keywords.append(set(arrays)))
    exported("npz", tmp_path)
    expected = {"actions"} | {key.replace("/", ".") for key in observation_keys(SAMPLE)}
    assert keywords == [expected] * len(keywords) != []


@pytest.mark.parametrize("kind", ["lerobot", "zarr"])
def test_baselines_train_on_it(kind, tmp_path):
    folder = exported(kind, tmp_path)
    spec = observation_spec("rgb+tacff", ("wrist",), ("right",), 32)
    (episode,) = read_episodes([folder], PEG, spec, 1)
    (original,) = read_episodes([SAMPLE], PEG, spec, 1)
    assert all(np.array_equal(episode[key][:-1], original[key][:-1]) for key in spec.keys)


def test_what_is_there_or_broken_is_said(tmp_path):
    folder = exported("zarr", tmp_path)
    with pytest.raises(DemonstrationError, match="exists already"):
        export.main(export.Args(SAMPLE, "zarr", folder))
    with pytest.raises(DemonstrationError, match=r"lacks \['front'\]; it holds \['action'"):
        list(diffusion_policy_zarr.read_zarr(folder, ["sensor_data/front/rgb"], 1))
    for file in (folder / "meta").rglob("*"):
        if file.is_file():
            file.unlink()
    with pytest.raises(DemonstrationError, match="is no store of the paper's layout"):
        diffusion_policy_zarr.count_episodes(folder)
    assert not list(tmp_path.glob("*.partial"))


def test_formats_are_told_apart_by_what_lies_there(tmp_path):
    assert format_of(SAMPLE) is MANISKILL_H5
    for kind in ("lerobot", "zarr"):
        known = format_of(exported(kind, tmp_path))
        assert known.name == kind
        assert known.count(tmp_path / kind) == 2
        assert len(list(known.read(tmp_path / kind, KEYS))) == 2
    with pytest.raises(DemonstrationError, match=r"is a folder, but no LeRobot dataset or zarr store; give one"):
        format_of(tmp_path)
