"""What vision and touch carry: `python -m manifeel_ms3.analysis.information_audit --demos data/demos --out runs/audit`.

Small probes, trained on recorded observations of one camera or one pad at one moment, tell what a policy would need to know:
which ball is held, where the battery is, at what angle the peg lies in the hand. What a probe cannot tell from a modality, a
policy that has that modality alone will hardly know. Answers are cross-validated over episodes.
"""

import logging
import sys
import textwrap
import warnings
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from manifeel_ms3.command_line import run
from manifeel_ms3.demonstrations.formats.maniskill_h5 import DemonstrationError, open_trajectories, read_header
from manifeel_ms3.files import write_json, write_text
from manifeel_ms3.geometry import bulb_and_holder, nut_and_bolt
from manifeel_ms3.progress import progress_bar
from manifeel_ms3.tasks.exploration.object_search import CONTAINER_XY
from manifeel_ms3.tasks.registry import short_name, task_spec

log = logging.getLogger(__name__)
MODALITIES = ("camera", "tacrgb", "tacff")
FOLDS = 5
COMPONENTS = 64  # principal components of the features that a probe sees
GRID, SCALES = 16, (1.0, 2.0, 4.0, 8.0)  # cells a side; pixels
TOUCHES, FREE = 1.5, 0.5  # N: of a held part on the world
Recorded = Any  # an episode's group in a trajectory file
Samples = Iterator[tuple[int, float]]


# -------------------------------------------------------------------- questions


@dataclass(frozen=True)
class Question:
    """Something that an observation may tell: `samples(episode)` yields (index of the observation, answer)."""

    name: str
    env_id: str
    samples: Callable[[Recorded], Samples]
    unit: str = ""
    """of a number to estimate; "" where the answer is one of two classes"""


def _position(episode: Recorded, name: str) -> np.ndarray:
    return episode[f"env_states/actors/{name}"][:, :3]


def _closings(episode: Recorded) -> list[int]:
    """Observations at which the fingers have just closed."""
    closed = episode["actions"][:, -1] < 0.5
    starts = np.flatnonzero(closed & ~np.r_[False, closed[:-1]])
    return [int(start) + 6 for start in starts if start + 6 < len(closed)]


def _which_ball(episode: Recorded) -> Samples:
    tool = episode["obs/extra/tcp_pose"][:, :3]
    for t in _closings(episode)[:1]:  # the first guess is right as often as wrong
        away = [np.linalg.norm(_position(episode, f"{ball}_ball")[t] - tool[t]) for ball in ("golf", "tennis")]
        yield t, float(away[0] < away[1])


def _battery_place(episode: Recorded) -> Samples:
    far = float(_position(episode, "battery")[0, 0] > CONTAINER_XY[0])
    for t in (1, 4, 7):
        yield t, far


def _battery_in_hand(episode: Recorded) -> Samples:
    tool = episode["obs/extra/tcp_pose"][:, :3]
    for t in _closings(episode)[:1]:
        yield t, float(np.linalg.norm((_position(episode, "battery")[t] - tool[t])[:2]) < 0.04)


def _pitch_in_hand(episode: Recorded) -> Samples:
    (name,) = [name for name in episode["env_states/actors"] if name.endswith("peg")]
    plug = episode[f"env_states/actors/{name}"][:, 3:7]
    tool = episode["obs/extra/tcp_pose"][:, 3:7]
    for t in (1, 4, 7):
        held = Rotation.from_quat(tool[t][[1, 2, 3, 0]]).inv() * Rotation.from_quat(plug[t][[1, 2, 3, 0]])
        yield t, float(np.rad2deg(held.as_rotvec()[1]))


def _in_contact(episode: Recorded) -> Samples:
    force = episode["contact_force"][()]
    for t in range(0, len(force), 4):
        if force[t] > TOUCHES or force[t] < FREE:
            yield t + 1, float(force[t] > TOUCHES)


def _descent(episode: Recorded, held: str, fixed: str, engaged: float) -> np.ndarray:
    return engaged - (_position(episode, held)[:, 2] - _position(episode, fixed)[:, 2])


def _touching(episode: Recorded, every: int) -> Iterator[int]:
    """Observations of a held part that touches the world."""
    force = episode["contact_force"][()]
    return (t + 1 for t in range(0, len(force), every) if force[t] > TOUCHES)


def _thread_engaged(episode: Recorded) -> Samples:
    screw = nut_and_bolt()
    descent = _descent(episode, "nut", "bolt", screw.engaged)
    for t in _touching(episode, 4):
        if abs(descent[t]) < screw.pitch:
            yield t, float(descent[t] > 0)


def _tightened(episode: Recorded) -> Samples:
    screw = bulb_and_holder()
    gap = screw.engaged - screw.seated - _descent(episode, "bulb", "holder", screw.engaged)
    for t in _touching(episode, 3):
        if gap[t] < 0.5 * screw.pitch:
            yield t, float(gap[t] < -2e-4)  # the contact's spring is pressed in


QUESTIONS = (
    Question("ball in the hand: golf or table tennis", "ManiFeel-BallSorting-v1", _which_ball),
    Question("ball in the hand: golf or table tennis", "ManiFeel-BallSortingDim-v1", _which_ball),
    Question("battery's place, before contact", "ManiFeel-ObjectSearch-v1", _battery_place),
    Question("battery between the fingers or not, once closed", "ManiFeel-ObjectSearch-v1", _battery_in_hand),
    Question("peg's pitch in the hand", "ManiFeel-PegInsertion-v1", _pitch_in_hand, "degrees"),
    Question("peg's pitch in the hand", "ManiFeel-PegReorientation-v1", _pitch_in_hand, "degrees"),
    Question("peg touches or not", "ManiFeel-PegInsertion-v1", _in_contact),
    Question("peg touches or not", "ManiFeel-PegReorientation-v1", _in_contact),
    Question("thread engaged or resting on it", "ManiFeel-NutBoltAssembly-v1", _thread_engaged),
    Question("bulb tight or not yet", "ManiFeel-BulbInstallation-v1", _tightened),
)


# -------------------------------------------------------------------- features and probes


def image_features(image: np.ndarray) -> np.ndarray:
    """Features (1792,) of a picture (H, W, 3) uint8: colours on a grid, and how much it varies there at four scales."""
    picture = image.astype(np.float32) / 255

    def pooled(values: np.ndarray) -> np.ndarray:
        return cv2.resize(values, (GRID, GRID), interpolation=cv2.INTER_AREA).ravel()

    grey = picture.mean(-1)
    blurred = [grey] + [cv2.GaussianBlur(grey, (0, 0), scale) for scale in SCALES]
    bands = [np.abs(fine - coarse) for fine, coarse in zip(blurred, blurred[1:], strict=False)]
    return np.concatenate([pooled(picture), *(pooled(band) for band in bands)])


def _sensor(env_id: str, modality: str) -> str:
    """What a probe sees: the task's policy camera, or the right pad."""
    return task_spec(env_id).policy_camera if modality == "camera" else "tactile_right"


def _features(episode: Recorded, sensor: str, modality: str, t: int) -> np.ndarray:
    seen = episode[f"obs/sensor_data/{sensor}"]
    return seen["force_field"][t].ravel() if modality == "tacff" else image_features(seen["rgb"][t])


@dataclass
class Answer:
    """How well one modality answers a question. `score`: share of right answers, each class weighing the same, or root mean
    square error in `unit`; `interval`: 95 %, from a bootstrap over episodes; `chance`: the score of an answer that never looks.
    """

    question: str
    env_id: str
    modality: str
    unit: str
    score: float
    interval: tuple[float, float]
    chance: float
    episodes: int
    samples: int
    sensor: str


def ask(question: Question, path: Path) -> list[Answer]:
    """Answers of every modality, from one trajectory file.

    Raises:
        DemonstrationError: the file lacks what is asked of, or has too few episodes to cross-validate.
    """
    header = read_header(path)
    if len(header["episodes"]) < 2 * FOLDS:
        raise DemonstrationError(
            f"{path} holds {len(header['episodes'])} episodes, at least {2 * FOLDS} are needed; record more"
        )
    answers, groups = [], []
    features: dict[str, list[np.ndarray]] = {modality: [] for modality in MODALITIES}
    with open_trajectories(path) as file:
        for i in range(len(header["episodes"])):
            episode = file[f"traj_{i}"]
            for t, answer in question.samples(episode):
                answers.append(answer)
                groups.append(i)
                for modality, rows in features.items():
                    try:
                        rows.append(_features(episode, _sensor(question.env_id, modality), modality, t))
                    except KeyError as error:
                        raise DemonstrationError(
                            f"{path} lacks {modality} of {_sensor(question.env_id, modality)} ({error}); record it with "
                            "obs_mode rgb+tacrgb+tacff, the task's policy camera and the right pad"
                        ) from error
    if len(set(groups)) < 2 * FOLDS:
        raise DemonstrationError(
            f"{path}: {len(set(groups))} episodes answer {question.name!r}, {2 * FOLDS} are needed; record more"
        )
    truth, episodes = np.array(answers), np.array(groups)
    out = []
    for modality, rows in features.items():
        guess = probe(np.stack(rows), truth, episodes, numeric=bool(question.unit))
        score, low, high = _score(truth, guess, episodes, bool(question.unit))
        usual = np.full_like(truth, truth.mean() if question.unit else float(truth.mean() > 0.5))
        chance = _score(truth, usual, episodes, bool(question.unit))[0]
        seen = (len(set(groups)), len(truth), _sensor(question.env_id, modality))
        out.append(Answer(question.name, question.env_id, modality, question.unit, score, (low, high), chance, *seen))
    return out


def probe(features: np.ndarray, truth: np.ndarray, episodes: np.ndarray, numeric: bool) -> np.ndarray:
    """Answers (n,) of a small machine on features (n, d), each from a fit without that episode.

    A class by a support vector machine, a number by a Gaussian process; both on principal components.
    """
    from sklearn.decomposition import PCA
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
    from sklearn.model_selection import GroupKFold, cross_val_predict
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler
    from sklearn.svm import SVC

    features = features[:, features.std(0) > 0]
    if not features.size:  # the sensor shows the same at all times
        features = np.zeros((len(truth), 1))
    components = PCA(min(COMPONENTS, features.shape[1], len(truth) // 2), random_state=0)
    if numeric:
        kernel = ConstantKernel(1.0) * RBF(10.0) + WhiteKernel(0.1)
        pipeline = make_pipeline(components, GaussianProcessRegressor(kernel, normalize_y=True))
    else:
        pipeline = make_pipeline(StandardScaler(), components, SVC(C=10.0, class_weight="balanced"))
    # no fault: a picture without change has no variance to share out, and a fit may end at its kernel's bounds
    with np.errstate(invalid="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        return cross_val_predict(pipeline, features, truth, groups=episodes, cv=GroupKFold(FOLDS))


def _score(truth: np.ndarray, guess: np.ndarray, episodes: np.ndarray, numeric: bool, resamples: int = 1000):
    """Score and its 95 % interval, from a bootstrap over episodes."""
    right = (guess - truth) ** 2 if numeric else (guess == truth).astype(float)
    kinds = np.zeros(len(truth)) if numeric else truth
    own = (episodes[:, None] == np.unique(episodes)).T[:, None] & (
        kinds[:, None] == np.unique(kinds)
    ).T  # episode, class, sample
    sums, counts = own @ right, own.sum(-1)
    drawn = np.random.default_rng(0).integers(len(own), size=(resamples, len(own)))
    drawn = np.concatenate([np.arange(len(own))[None], drawn])  # the first is the recording itself
    with np.errstate(invalid="ignore"):  # a class that was not drawn
        values = np.nanmean(sums[drawn].sum(1) / counts[drawn].sum(1), axis=1)
    values = np.sqrt(values) if numeric else values
    return float(values[0]), *(float(x) for x in np.quantile(values[1:], [0.025, 0.975]))


# -------------------------------------------------------------------- table and figure


def table(answers: list[Answer]) -> str:
    """Markdown: a row a question, a column a modality."""
    lines = ["| task | question | chance | camera | TacRGB | TacFF |", "|---|---|---|---|---|---|"]
    for rows in _by_question(answers):
        cells = {answer.modality: _cell(answer) for answer in rows}
        first = rows[0]
        chance = f"{first.chance:.1f}°" if first.unit else f"{first.chance:.0%}"
        task = short_name(first.env_id)
        scores = f"{cells['camera']} ({first.sensor}) | {cells['tacrgb']} | {cells['tacff']}"
        lines.append(f"| {task} | {first.question} | {chance} | {scores} |")
    return "\n".join(lines) + "\n"


def _cell(answer: Answer) -> str:
    low, high = answer.interval
    if answer.unit:
        return f"{answer.score:.1f}° [{low:.1f}, {high:.1f}]"
    return f"{answer.score:.0%} [{100 * low:.0f}, {100 * high:.0f}]"


def _by_question(answers: list[Answer]) -> list[list[Answer]]:
    return [answers[k : k + len(MODALITIES)] for k in range(0, len(answers), len(MODALITIES))]


def figure(answers: list[Answer], path: Path) -> None:
    """Bars of every question's scores, with their intervals, and chance."""
    from matplotlib.figure import Figure

    rows = _by_question(answers)
    fig = Figure(figsize=(2.1 * len(rows), 3.4), layout="constrained")
    axes = fig.subplots(1, len(rows))
    for ax, group in zip(np.atleast_1d(axes), rows, strict=True):
        factor = 1 if group[0].unit else 100
        score = np.array([answer.score for answer in group]) * factor
        spread = np.array([answer.interval for answer in group]).T * factor
        ax.bar(range(3), score, color=["#8a8f98", "#c7793a", "#3a74c7"])
        ax.errorbar(range(3), score, np.abs(spread - score), fmt="none", ecolor="black", capsize=3, lw=1)
        ax.axhline(group[0].chance * factor, color="black", ls=":", lw=1)
        ax.set_xticks(range(3), ["camera", "TacRGB", "TacFF"], fontsize=7)
        ax.set_ylabel("RMSE, degrees" if group[0].unit else "right answers, %", fontsize=7)
        ax.tick_params(axis="y", labelsize=7)
        if not group[0].unit:
            ax.set_ylim(0, 105)
        task = short_name(group[0].env_id)
        ax.set_title(f"{task}\n{textwrap.fill(group[0].question, 28)}", fontsize=7)
    fig.savefig(path, dpi=130)


@dataclass
class Args:
    demos: Path = Path("data/demos")
    """folder that `manifeel_ms3.demonstrations.dataset` has written"""
    out: Path = Path("runs/audit")
    """folder for audit.json, audit.md and audit.png"""


def main(args: Args) -> list[Answer]:
    """Ask every question whose task has been recorded.

    Raises:
        DemonstrationError: there is no recording of any.
        ModuleNotFoundError: the extra is not installed.
    """
    try:
        import sklearn  # noqa: F401
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"{error}; the audit needs `pip install manifeel_ms3[audit]`") from error
    paths = {question: args.demos / question.env_id / "trajectory.h5" for question in QUESTIONS}
    asked = {question: path for question, path in paths.items() if path.is_file()}
    for question in set(QUESTIONS) - set(asked):
        log.warning("%s has not been recorded in %s: left out", question.env_id, args.demos)
    if not asked:
        raise DemonstrationError(
            f"{args.demos} holds no <task>/trajectory.h5; record with `python -m manifeel_ms3.demonstrations.dataset`"
        )
    answers: list[Answer] = []
    with progress_bar() as bar:
        for question, path in bar.track(asked.items(), description="asking"):
            answers += ask(question, path)
    args.out.mkdir(parents=True, exist_ok=True)
    write_json(args.out / "audit.json", [asdict(answer) for answer in answers])
    write_text(args.out / "audit.md", table(answers))
    figure(answers, args.out / "audit.png")
    log.info("%s", table(answers))
    return answers


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args)))
