"""Videos of recorded and evaluated episodes show every moment that they should, or say why there is none."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from manifeel_ms3 import cli
from manifeel_ms3.demonstrations import DemonstrationError
from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.evaluation.checkpoint_config import CheckpointError
from manifeel_ms3.tasks.registry import task_spec
from manifeel_ms3.videos import __main__ as film
from manifeel_ms3.videos import layout
from manifeel_ms3.videos.__main__ import read_source
from manifeel_ms3.videos.shots import Shot, Take, shown_steps
from manifeel_ms3.videos.video_file import END_SECONDS, write_video
from tests.sample import states_sample
from tests.tasks_and_marks import PEG, needs_renderer

FILE = states_sample(PEG)


def a_take() -> Take:
    rng = np.random.default_rng(0)
    touch = dict.fromkeys(("tactile right: TacRGB", "tactile right: TacFF"), (240, 320))
    sizes = {"scene": (480, 480), "wrist": (256, 256)} | touch
    shots = [Shot(k, {name: rng.integers(0, 255, (*size, 3), np.uint8) for name, size in sizes.items()}) for k in (0, 2, 4)]
    return Take("PegInsertion, seed 0", 36.0, shots, [0.0, 1.0, 9.0, 2.0, 0.0], [False, False, False, False, True])


def test_the_first_and_the_last_step_are_shown():
    assert shown_steps(64, None) == set(range(65))
    assert shown_steps(64, 5) == {0, 16, 32, 48, 64}
    assert shown_steps(3, 40) == {0, 1, 2, 3}


def test_a_frame_shows_each_image_at_its_place_and_the_force_so_far():
    take = a_take()
    frames = [np.asarray(frame) for frame in layout.video_frames(take)]
    assert all(frame.shape == (layout.SIZE[1], layout.SIZE[0], 3) for frame in frames)
    np.testing.assert_array_equal(frames[1][layout.BAR :, :480][:480], take.shots[1].images["scene"])
    touch = frames[1][layout.BAR + 40 : layout.BAR + 240, -layout.WIDE :]
    np.testing.assert_array_equal(touch, take.shots[1].images["tactile right: TacRGB"][40:240])
    drawn = [(frame == layout.CURVE).all(-1).sum() for frame in frames]
    assert drawn[0] < drawn[1] < drawn[2]  # the curve grows
    succeeded = [(frame[: layout.BAR] == layout.SUCCESS).all(-1).any() for frame in frames]
    assert succeeded == [False, False, True]


def test_the_time_in_the_title_is_that_of_the_control_rate():
    slow, fast = a_take(), a_take()
    slow.control_freq, fast.control_freq, fast.successes = 10, 20, [False] * 5
    at_step = [list(layout.video_frames(take)) for take in (slow, fast)]
    titles = [np.asarray(frame)[: layout.BAR] for frame in (at_step[0][1], at_step[1][2])]
    np.testing.assert_array_equal(*titles)  # step 2 at 10 Hz and step 4 at 20 Hz are both at 0.2 s


@pytest.mark.parametrize("suffix", ["webp", "gif"])
def test_an_animation_has_every_frame_and_stops_at_the_end(tmp_path, suffix):
    frames = list(layout.video_frames(a_take()))
    write_video([frames], tmp_path / f"video.{suffix}", fps=10, width=400)
    with Image.open(tmp_path / f"video.{suffix}") as video:
        assert video.n_frames >= len(frames)
        assert video.size == (400, 198)
        lasted = 0
        for k in range(video.n_frames):
            video.seek(k)
            video.load()
            lasted += video.info["duration"]
    assert lasted == pytest.approx(1000 * (0.1 * len(frames) + END_SECONDS), abs=100)


def test_an_mp4_has_every_frame(tmp_path):
    imageio = pytest.importorskip("imageio.v2")
    frames = list(layout.video_frames(a_take()))
    write_video([frames, frames], tmp_path / "video.mp4", fps=4)
    with imageio.get_reader(tmp_path / "video.mp4") as video:
        assert video.count_frames() == 2 * (len(frames) + round(4 * END_SECONDS))


def last_frame(out: Path, *arguments: str) -> np.ndarray:
    assert cli.main(["film", str(FILE), "--out", str(out), "--max-frames", "2", "--width", "524", *arguments]) == 0
    with Image.open(out) as video:
        assert video.size == (524, 260)
        video.seek(video.n_frames - 1)
        return np.asarray(video.convert("RGB")).astype(int)


@needs_renderer
def test_a_file_of_states_alone_is_rendered_anew_from_the_camera_and_the_pad_that_are_asked_for(tmp_path, capsys):
    usual = last_frame(tmp_path / "peg.webp")
    touch = usual[20:130, -150:]
    assert touch.std() > 10  # TacRGB of a held peg is not one colour
    other = last_frame(tmp_path / "other.webp", "--camera", "front", "--pad", "left")
    places = dict(
        scene=(slice(20, 260), slice(0, 240)), camera=(slice(40, 130), slice(250, 360)), pad=(slice(40, 130), slice(380, 520))
    )
    change = {name: np.abs(usual[place] - other[place]).mean() for name, place in places.items()}
    assert change["scene"] < 3.0
    assert change["camera"] > 10.0
    assert change["pad"] > 1.0


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--out", "peg.avi"], "peg.avi is not a path of a video; give a file that ends in .mp4, .webp, .gif"),
        (["--out", "peg.gif", "--fps", "30"], "--fps 30 is not possible in a GIF, which has [1, 2, 4, 5, 10, 20, 25, 50]"),
        (["--episode", "7"], "has the episodes 0 to 1"),
        (["--camera", "top"], "--camera='top' is unknown; choose from"),
        (["--pad", "both"], "--pad='both' is unknown; choose from"),
        (["--max-frames", "1"], "--max-frames 1 is too small; give 2 or more"),
        (["--checkpoint", "last"], "--checkpoint without a result of an evaluation"),
        (["--policy", "a:B", "--checkpoint", "last"], "give either --checkpoint or --policy"),
        (["--policy-kwargs", "{x"], "--policy-kwargs '{x' is not json"),
    ],
)
def test_what_cannot_be_filmed_is_refused_in_one_line(arguments, said, capsys):
    assert cli.main(["film", str(FILE), *arguments]) == 1
    error = capsys.readouterr().err
    assert said in error
    assert len(error.splitlines()) == 2  # the error, and where there is more


def test_a_file_that_is_not_there(tmp_path, capsys):
    assert cli.main(["film", str(tmp_path / "x.h5")]) == 1
    assert "x.h5 does not exist" in capsys.readouterr().err


def test_an_export_is_not_taken_for_the_recording_beside_it(tmp_path, capsys):
    for suffix in (".h5", ".json"):
        shutil.copy(FILE.with_suffix(suffix), tmp_path / f"peg{suffix}")
    (tmp_path / "peg.zarr").mkdir()
    assert cli.main(["film", str(tmp_path / "peg.zarr"), "--episode", "7"]) == 1
    assert "peg.zarr is a folder; give a trajectory file" in capsys.readouterr().err
    assert read_source(tmp_path / "peg.json", 0).path == tmp_path / "peg.h5"


def copy_of_result(folder: Path, revision: int) -> Path:
    """A copy of a result that says this revision of its task."""
    result = json.loads(Path("tests/trust/result.json").read_text())
    path = folder / "evaluation.json"
    path.write_text(json.dumps(result | dict(revision=revision)))
    return path


def test_a_result_without_its_policy_says_what_to_give(tmp_path, capsys):
    assert cli.main(["film", str(copy_of_result(tmp_path, task_spec(PEG).revision))]) == 1
    assert "give its --checkpoint or --policy" in capsys.readouterr().err


def test_a_result_of_an_earlier_revision_of_its_task_is_not_run_again(tmp_path):
    path = copy_of_result(tmp_path, here := task_spec(PEG).revision - 1)
    with pytest.raises(DemonstrationError, match=f"it is of revision {here} of {PEG}, but the task has revision {here + 1}"):
        read_source(path, 0)


def test_a_result_names_the_seed_and_the_length_of_an_episode(tmp_path):
    path = copy_of_result(tmp_path, task_spec(PEG).revision)
    episodes = json.loads(path.read_text())["episodes"]
    source = read_source(path, len(episodes) - 1)
    assert (source.seed, source.length) == (episodes[-1]["seed"], episodes[-1]["episode_len"])
    with pytest.raises(InvalidArgumentError, match="has the episodes 0 to"):
        read_source(path, len(episodes))


def test_a_result_is_shown_with_the_checkpoint_that_was_evaluated(tmp_path):
    path = copy_of_result(tmp_path, task_spec(PEG).revision)
    step = json.loads(path.read_text())["config"]["step"]
    later = tmp_path / "checkpoints" / f"{step + 1:08d}"
    later.mkdir(parents=True)
    (later / "config.json").write_text(json.dumps(dict(policy_name="diffusion_policy", step=step + 1)))
    (later.parent / "last").symlink_to(later.name)
    said = f"is of step {step}, whose checkpoint is not in"
    with pytest.raises(CheckpointError, match=said):
        film.main(film.Args((path,), tmp_path / "video.mp4"))
