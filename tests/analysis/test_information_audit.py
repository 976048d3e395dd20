"""The information audit finds information that is there, and none where there is none."""

import json
import shutil

import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from manifeel_ms3.analysis import information_audit
from manifeel_ms3.analysis.probes import register_probe
from manifeel_ms3.demonstrations import DemonstrationError
from manifeel_ms3.demonstrations.recording import observed_file
from manifeel_ms3.errors import UnknownNameError
from manifeel_ms3.geometry import bulb_and_holder, nut_and_bolt
from manifeel_ms3.tasks.registry import all_tasks, task_spec

pytest.importorskip("sklearn")
RNG = np.random.default_rng(0)
EPISODES = 24


def test_a_prediction_knows_a_class_that_shows_and_not_one_that_does_not():
    truth = np.repeat(RNG.integers(2, size=60), 3).astype(float)
    episodes = np.repeat(np.arange(60), 3)
    noise = RNG.normal(size=(len(truth), 40))
    shown = noise + 2.0 * truth[:, None]
    assert (information_audit.cross_validated(shown, truth, episodes, numeric=False) == truth).mean() > 0.95
    assert 0.3 < (information_audit.cross_validated(noise, truth, episodes, numeric=False) == truth).mean() < 0.7


def test_a_prediction_does_not_learn_an_episode_by_heart():
    """Features that name the episode say nothing about episodes that it has not seen."""
    truth = np.repeat(RNG.integers(2, size=40), 5).astype(float)
    episodes = np.repeat(np.arange(40), 5)
    names = np.eye(40)[episodes]
    assert (information_audit.cross_validated(names, truth, episodes, numeric=False) == truth).mean() < 0.75


def test_an_answer_that_never_looks_scores_a_half_however_rare_a_class():
    truth, episodes = np.r_[np.zeros(95), np.ones(5)], np.arange(100) // 5
    assert information_audit._score(truth, np.zeros(100), episodes, numeric=False)[0] == 0.5
    assert information_audit._score(truth, truth, episodes, numeric=False) == (1.0, 1.0, 1.0)


def test_a_prediction_estimates_a_number():
    angle = RNG.uniform(-30, 30, 80)
    features = np.stack([np.sin(np.deg2rad(angle + k)) for k in range(0, 90, 5)], axis=1)
    assert np.abs(information_audit.cross_validated(features, angle, np.arange(80), numeric=True) - angle).max() < 1.0


@pytest.mark.parametrize("numeric", [False, True])
@pytest.mark.filterwarnings("error")
def test_a_sensor_that_never_changes_is_no_better_than_chance_and_no_fault(numeric):
    truth = np.tile([0.0, 1.0], 30)
    predicted = information_audit.cross_validated(np.ones((60, 5)), truth, np.arange(60) // 2, numeric)
    assert np.abs(predicted - truth).mean() == pytest.approx(0.5, abs=0.01)


def test_texture_shows_in_the_features():
    smooth = np.full((120, 160, 3), 128, np.uint8)
    rough = np.clip(128 + 20 * RNG.normal(size=smooth.shape), 0, 255).astype(np.uint8)
    energy = [information_audit.image_features(image)[3 * information_audit.GRID**2 :].sum() for image in (smooth, rough)]
    assert energy[0] == pytest.approx(0, abs=1e-4)
    assert energy[1] > 10


@pytest.fixture
def recorded(tmp_path):
    """ObjectSearch episodes with a field that shows the battery and a picture that does not."""
    task = tmp_path / "ManiFeel-ObjectSearch-v1"
    task.mkdir()
    with h5py.File(task / "trajectory.h5", "w") as file:
        for i in range(EPISODES):
            place, steps = i % 2, 12
            group = file.create_group(f"traj_{i}")
            group["actions"] = np.zeros((steps, 7))
            group["actions"][6:, 2] = 0.5  # the hand lifts after its fingers have closed
            group["contact_force"] = np.zeros(steps, np.float32)
            group["env_states/actors/battery"] = np.tile([0.425 + 0.15 * place, *np.zeros(12)], (steps + 1, 1))
            group["obs/extra/tcp_pose"] = np.tile([0.425, 0, 0.1, 0, 1, 0, 0], (steps + 1, 1))
            sensors = group.create_group("obs/sensor_data")
            sensors["front/rgb"] = RNG.integers(0, 255, (steps + 1, 32, 32, 3), dtype=np.uint8)
            sensors["tactile_right/rgb"] = RNG.integers(0, 255, (steps + 1, 24, 32, 3), dtype=np.uint8)
            sensors["tactile_right/force_field"] = np.full((steps + 1, 10, 14, 3), place, np.float32)
    episodes = [dict(episode_id=i, episode_seed=i, elapsed_steps=1, success=True) for i in range(EPISODES)]
    header = dict(
        env_info=dict(env_id="manifeel_ms3:ManiFeel-ObjectSearch-v1", env_kwargs=dict(obs_mode="tacrgb+tacff")),
        episodes=episodes,
    )
    (task / "trajectory.json").write_text(json.dumps(header))
    return tmp_path


def test_audit_writes_table_figure_and_numbers(recorded, tmp_path):
    answers = information_audit.main(information_audit.Args(recorded, tmp_path / "out"))
    before = {answer.modality: answer for answer in answers if "before" in answer.question}
    assert before["tacff"].score == 1.0
    assert before["camera"].score < 0.8
    assert before["camera"].sensor == "front"
    low, high = before["camera"].interval
    assert low < before["camera"].score < high
    assert "100%" in (tmp_path / "out/audit.md").read_text()
    assert (tmp_path / "out/audit.png").stat().st_size > 5000
    assert len(json.loads((tmp_path / "out/audit.json").read_text())) == len(answers)


def test_audit_finds_episodes_by_their_numbers(recorded, tmp_path):
    path = recorded / "ManiFeel-ObjectSearch-v1/trajectory.h5"
    header = json.loads(path.with_suffix(".json").read_text())
    with h5py.File(path, "r+") as file:
        for episode in header["episodes"]:
            number = EPISODES + 3 * episode["episode_id"]  # with gaps
            file.move(f"traj_{episode['episode_id']}", f"traj_{number}")
            episode["episode_id"] = number
    path.with_suffix(".json").write_text(json.dumps(header))
    answers = information_audit.main(information_audit.Args(recorded, tmp_path / "out"))
    assert [answer.score for answer in answers if "before" in answer.question and answer.modality == "tacff"] == [1.0]


def test_audit_asks_another_camera(recorded, tmp_path):
    another = information_audit.Args(recorded, tmp_path / "out", camera="wrist")
    with pytest.raises(DemonstrationError, match="lacks camera of wrist"):
        information_audit.main(another)
    with h5py.File(recorded / "ManiFeel-ObjectSearch-v1/trajectory.h5", "r+") as file:
        for i in range(EPISODES):
            sensors = file[f"traj_{i}/obs/sensor_data"]
            sensors["wrist/rgb"] = np.full_like(sensors["front/rgb"][:], 200 * (i % 2))
    answers = [answer for answer in information_audit.main(another) if answer.modality == "camera"]
    assert [(answer.sensor, answer.score) for answer in answers if "before" in answer.question] == [("wrist", 1.0)]


def test_a_task_gets_another_question_with_one_decorator(recorded, tmp_path, monkeypatch):
    spec = task_spec("ManiFeel-ObjectSearch-v1")
    monkeypatch.setattr(spec, "probes", list(spec.probes))

    @register_probe(spec.env_id, question="which half, in metres", unit="m")
    def half(episode):
        yield 2, float(episode["env_states/actors/battery"][2, 0])

    results = information_audit.main(information_audit.Args(recorded, tmp_path / "out"))
    added = {result.modality: result for result in results if result.question == "which half, in metres"}
    assert added["tacff"].score < 0.01 < added["tacff"].chance
    assert "which half, in metres | 0.1 m |" in (tmp_path / "out/audit.md").read_text()
    with pytest.raises(UnknownNameError, match="'Nothing-v1' is not registered"):
        register_probe("Nothing-v1", question="?")(half)


def test_questions_are_asked_where_the_paper_says_that_touch_decides():
    questions = {spec.name: [probe.question for probe in spec.probes] for spec in all_tasks().values() if spec.probes}
    assert len(questions) == 7
    assert sum(map(len, questions.values())) == 10
    assert questions["PegInsertion"] == ["peg's pitch in the hand", "peg touches or not"]


def test_the_weight_of_a_held_part_is_not_a_contact_with_the_world():
    (contact,) = [probe for probe in task_spec("ManiFeel-PegReorientation-v1").probes if probe.question == "peg touches or not"]
    force = np.full(40, 0.7, np.float32)  # a steel peg of 70 g
    force[20:] = 6.0
    samples = dict(contact.samples(dict(contact_force=force)))
    assert {t for t, touches in samples.items() if touches} == {t for t in samples if t > 20}
    assert len(samples) == 10


@pytest.mark.parametrize("after", ["opens", "lifts"])
def test_a_ball_is_judged_before_the_hand_does_what_follows_from_it(after):
    """Fingers that have opened, or a hand that lifts, would show in the camera what the demonstrator felt."""
    (held,) = task_spec("ManiFeel-BallSorting-v1").probes
    actions = np.zeros((20, 7), np.float32)
    actions[:, -1] = 1.0
    actions[8:12, -1] = -0.4
    if after == "lifts":
        actions[12:, -1], actions[12:, 2] = -0.4, 0.2
    balls = {f"env_states/actors/{name}_ball": np.zeros((21, 13)) for name in ("golf", "tennis")}
    balls["env_states/actors/tennis_ball"][:, 1] = 0.05
    episode = dict(actions=actions) | balls | {"obs/extra/tcp_pose": np.zeros((21, 7))}
    assert list(held.samples(episode)) == [(12, 1.0)]


def test_audit_refuses_a_question_with_one_answer(recorded, tmp_path):
    with h5py.File(recorded / "ManiFeel-ObjectSearch-v1/trajectory.h5", "r+") as file:
        for episode in file.values():
            episode["env_states/actors/battery"][:, 0] = 0.425
    with pytest.raises(DemonstrationError, match='before contact" is 0 at all 72 moments'):
        information_audit.main(information_audit.Args(recorded, tmp_path / "out"))


def test_audit_refuses_an_answer_that_too_few_episodes_have(recorded, tmp_path):
    with h5py.File(recorded / "ManiFeel-ObjectSearch-v1/trajectory.h5", "r+") as file:
        for name, episode in file.items():
            episode["env_states/actors/battery"][:, 0] = 0.575 if name == "traj_3" else 0.425
    with pytest.raises(DemonstrationError, match="one of the two answers occurs in too few episodes"):
        information_audit.main(information_audit.Args(recorded, tmp_path / "out"))


def test_audit_asks_the_file_of_a_task_that_has_all_observations(recorded):
    task = recorded / "ManiFeel-ObjectSearch-v1"
    modes = ("rgb+tacff", "rgb+tacrgb+tacff")
    for mode in modes:
        header = json.loads((task / "trajectory.json").read_text())
        header["env_info"]["env_kwargs"]["obs_mode"] = mode
        (task / f"trajectory.{mode}.json").write_text(json.dumps(header))
        shutil.copy(task / "trajectory.h5", task / f"trajectory.{mode}.h5")
    assert observed_file(task, modes[1]) == task / f"trajectory.{modes[1]}.h5"
    assert observed_file(task) == task / f"trajectory.{modes[0]}.h5"


def test_audit_says_what_is_missing(recorded, tmp_path):
    with pytest.raises(DemonstrationError, match="manifeel dataset"):
        information_audit.main(information_audit.Args(tmp_path / "nothing"))
    path = recorded / "ManiFeel-ObjectSearch-v1/trajectory.h5"
    with h5py.File(path, "r+") as file:
        del file["traj_3/obs/sensor_data/tactile_right/rgb"]
    with pytest.raises(DemonstrationError, match="lacks tacrgb of tactile_right"):
        information_audit.main(information_audit.Args(recorded, tmp_path / "out"))
    header = json.loads(path.with_suffix(".json").read_text())
    path.with_suffix(".json").write_text(json.dumps(header | dict(episodes=header["episodes"][:3])))
    with pytest.raises(DemonstrationError, match="3 episodes, at least"):
        information_audit.main(information_audit.Args(recorded, tmp_path / "out"))


def probe(task: str, question: str):
    (found,) = [one for one in task_spec(f"ManiFeel-{task}-v1").probes if question in one.question]
    return lambda episode: list(found.samples(episode))


def poses(position, rotation, steps: int = 12) -> np.ndarray:
    return np.tile([*position, *rotation.as_quat(scalar_first=True), *np.zeros(6)], (steps, 1))


def test_the_pitch_of_a_peg_is_its_turn_about_the_closing_axis_of_the_hand():
    hand = Rotation.from_euler("z", 40, degrees=True) * Rotation.from_quat([1, 0, 0, 0])
    held = hand * Rotation.from_euler("y", -7, degrees=True) * Rotation.from_euler("x", 2, degrees=True)
    episode = {"env_states/actors": ["peg"], "env_states/actors/peg": poses((0, 0, 0), held)}
    episode["obs/extra/tcp_pose"] = poses((0, 0, 0), hand)[:, :7]
    assert [t for t, _ in probe("PegInsertion", "pitch")(episode)] == [1, 4, 7]
    assert [answer for _, answer in probe("PegInsertion", "pitch")(episode)] == pytest.approx([-7.0] * 3, abs=0.1)


@pytest.mark.parametrize("task", ["NutBoltAssembly", "BulbInstallation"])
def test_a_screwed_part_is_asked_about_after_the_step_whose_force_it_feels(task):
    """The part is over the thread, or out of its seat, at even observations, and in it at odd ones."""
    nut, bulb = nut_and_bolt(), bulb_and_holder()
    out, within, held, fixed = dict(
        NutBoltAssembly=(nut.engaged + 1e-4, nut.engaged - 1e-4, "nut", "bolt"),
        BulbInstallation=(bulb.seated + 1e-4, bulb.seated - 4e-4, "bulb", "holder"),
    )[task]
    heights = np.where(np.arange(13) % 2, within, out)
    part = np.zeros((13, 13))
    part[:, 2] = heights
    force = np.full(12, 5.0)
    force[11] = 0.0  # the weight
    episode = {"contact_force": force, f"env_states/actors/{held}": part, f"env_states/actors/{fixed}": np.zeros((13, 13))}
    samples = probe(task, "thread engaged" if task.startswith("Nut") else "tight")(episode)
    stride = 4 if task.startswith("Nut") else 3
    expected = [(t + 1, float((t + 1) % 2)) for t in range(0, 11, stride)]
    assert samples == expected


def test_a_moment_is_answered_from_the_observation_of_that_moment(tmp_path, monkeypatch):
    """The field of one observation alone tells the answer."""
    spec = task_spec("ManiFeel-ObjectSearch-v1")
    monkeypatch.setattr(spec, "probes", [])

    @register_probe(spec.env_id, question="odd")
    def odd(episode):
        yield 5, float(episode["actions"][0, 0])

    rng = np.random.default_rng(0)
    with h5py.File(tmp_path / "t.h5", "w") as file:
        for i in range(24):
            group = file.create_group(f"traj_{i}")
            group["actions"] = np.full((8, 7), i % 2)
            field = rng.normal(size=(9, 10, 14, 3)).astype(np.float32)
            field[5] += 3.0 * (i % 2)
            picture = rng.integers(100, 110, (9, 32, 32, 3), dtype=np.uint8)
            picture[5] += 100 * np.uint8(i % 2)
            sensors = group.create_group("obs/sensor_data")
            sensors["tactile_right/force_field"], sensors["tactile_right/rgb"], sensors["front/rgb"] = field, picture, picture
    episodes = [dict(episode_id=i, episode_seed=i, elapsed_steps=8, success=True) for i in range(24)]
    about = dict(env_info=dict(env_id=spec.gym_id, env_kwargs=dict(obs_mode="tacrgb+tacff")), episodes=episodes)
    (tmp_path / "t.json").write_text(json.dumps(about))
    (asked,) = spec.probes
    assert [found.score for found in information_audit.run_probe(asked, spec.env_id, tmp_path / "t.h5")] == [1.0] * 3


def test_the_interval_of_a_score_is_that_of_episodes_and_not_of_their_moments():
    """All moments of an episode are answered alike: the interval is that of 30 episodes, however many moments each has."""
    rng = np.random.default_rng(0)
    right = rng.random(30) < 0.7
    truth = np.tile([0.0, 1.0], 300)
    episodes = np.repeat(np.arange(30), 20)
    predicted = np.where(right[episodes], truth, 1 - truth)
    score, low, high = information_audit._score(truth, predicted, episodes, numeric=False)
    half = 1.96 * np.sqrt(right.mean() * (1 - right.mean()) / 30)
    assert score == pytest.approx(right.mean())
    assert (high - low) / 2 == pytest.approx(half, rel=0.15)
