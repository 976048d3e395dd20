"""Measure what vision and touch tell: `manifeel audit --demo-path data/demos`.

Small predictors, fitted to recorded observations of one camera or one pad at one moment, answer the questions of
`manifeel_ms3.analysis.probes`, which a policy would need to answer. Where they cannot answer from a modality, a policy
that observes only that modality can hardly know the answer. Predictions are cross-validated over episodes.

The table and the figure go into the documentation, so the figure is a static image that matplotlib draws.
"""

import logging
import math
import sys
import textwrap
import warnings
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import tyro

from manifeel_ms3.command_line import missing_extras_named, run
from manifeel_ms3.demonstrations.formats.maniskill_h5 import DemonstrationError, group_of, open_trajectories, read_header
from manifeel_ms3.demonstrations.recording import observed_file
from manifeel_ms3.errors import InvalidArgumentError
from manifeel_ms3.files import write_json, write_text
from manifeel_ms3.progress import progress_bar
from manifeel_ms3.tasks.registry import TaskSpec, all_tasks, short_name, task_spec

from .estimates import TAILS
from .figures import save_figure
from .markdown import markdown_table, markdown_tables, shown
from .probes import EpisodeGroup, Probe

log = logging.getLogger(__name__)
MODALITIES = {"camera": "camera", "tacrgb": "TacRGB", "tacff": "TacFF"}
"""Names of the modalities, and their titles in the table and the figure."""
COLUMNS_OF_TABLE = ("task", "question", "chance", *MODALITIES.values())
"""Names of the columns of the table."""
OBSERVED = "rgb+tacrgb+tacff"
"""Observations that a recording must have."""
FOLDS = 5
"""Number of parts that the episodes are split into; each part is predicted from a fit to the others."""
FEWEST_EPISODES = 2 * FOLDS
"""Smallest number of episodes that a question needs: two in each part."""
COMPONENTS = 64
"""Number of principal components of the features that a predictor is fitted to; fewer than there are samples."""
GRID = 16
"""Number of cells of the features' grid along each side of an image."""
SCALES = (1.0, 2.0, 4.0, 8.0)
"""Standard deviations of the blurs between which an image's detail is measured, in pixels: an octave apart."""
RESAMPLES = 1000
"""Number of resamples of the bootstrap."""
SVM_PENALTY = 10.0
"""Penalty C of the support vector machine; ten times scikit-learn's default, for a closer fit to few samples."""
LENGTH_SCALE, NOISE = 10.0, 0.1
"""Initial values of the Gaussian process's kernel: length in units of the principal components, and variance of the noise as a
share of the answers'. Its fit replaces both."""
COLUMNS = 5
"""Largest number of panels in a row of the figure."""
PANEL = (2.1, 2.3)
"""Width and height of one question's panel in the figure, in inches."""
FONT_SIZE, TITLE_WIDTH = 8, 28
"""Size of the figure's letters in points, and letters in a line of a title, which then fits a panel."""
COLOURS = ("#8a8f98", "#c7793a", "#3a74c7")
"""Colours of the bars, in the order of MODALITIES."""
HEADROOM = 1.05
"""Upper end of an axis of shares, above 1, so that the line of an interval at 100 % is visible."""
CAP_SIZE = 3
"""Size of the caps at the ends of an interval, in points (matplotlib's `capsize`)."""
DPI = 130
"""Resolution of the figure, in pixels per inch."""


@dataclass
class ProbeResult:
    """How well one modality answers a question."""

    question: str
    """The question, in a few words."""
    env_id: str
    """Id of the task."""
    modality: str
    """"camera", "tacrgb" or "tacff"."""
    unit: str
    """Unit of the score if the answer is a number; empty if it is one of two classes."""
    score: float
    """Share of right answers, each class weighing the same; or root mean square error in `unit`."""
    interval: tuple[float, float]
    """Interval of 95 % of the score, from a bootstrap over episodes."""
    chance: float
    """Score of the best constant answer."""
    episodes: int
    """Number of episodes that answer the question."""
    samples: int
    """Number of moments at which it was asked."""
    sensor: str
    """Camera or pad that was observed."""


# -------------------------------------------------------------------- features


def image_features(image: np.ndarray) -> np.ndarray:
    """Features (1792,) of an image (H, W, 3) uint8: the colours on a grid, and the amount of detail there at four scales."""
    image = image.astype(np.float32) / 255

    def pooled(values: np.ndarray) -> np.ndarray:
        return cv2.resize(values, (GRID, GRID), interpolation=cv2.INTER_AREA).ravel()

    grey = image.mean(-1)
    blurred = [grey] + [cv2.GaussianBlur(grey, (0, 0), scale) for scale in SCALES]
    bands = [np.abs(fine - coarse) for fine, coarse in pairwise(blurred)]
    return np.concatenate([pooled(image), *(pooled(band) for band in bands)])


def _features(episode: EpisodeGroup, sensor: str, modality: str, t: int) -> np.ndarray:
    observed = episode[f"obs/sensor_data/{sensor}"]
    return observed["force_field"][t].ravel() if modality == "tacff" else image_features(observed["rgb"][t])


# -------------------------------------------------------------------- measurement


@dataclass
class _Data:
    """The data from which a question is answered: n moments of recorded episodes."""

    truth: np.ndarray
    """True answers (n,)."""
    episodes: np.ndarray
    """Numbers of the episodes (n,)."""
    features: dict[str, np.ndarray]
    """Features (n, d) by modality."""


def run_probe(probe: Probe, env_id: str, path: Path, camera: str | None = None) -> list[ProbeResult]:
    """Ask a question of every modality.

    Args:
        probe: The question.
        env_id: Id of the task.
        path: Trajectory file of the task.
        camera: Camera that is asked; the task's policy camera if not given.

    Raises:
        DemonstrationError: The file lacks an observation, has too few episodes to cross-validate, or always the same answer.
    """
    sensors = dict.fromkeys(MODALITIES, "tactile_right") | dict(camera=camera or task_spec(env_id).policy_camera)
    data = _read(probe, path, sensors)
    numeric = bool(probe.unit)
    constant = data.truth.mean() if numeric else float(data.truth.mean() > 0.5)
    chance = _score(data.truth, np.full_like(data.truth, constant), data.episodes, numeric)[0]
    results = []
    for modality, features in data.features.items():
        try:
            predicted = cross_validated(features, data.truth, data.episodes, numeric)
        except DemonstrationError as error:
            raise DemonstrationError(f"{path}: of {probe.question!r}, {error}; record more episodes") from error
        score, low, high = _score(data.truth, predicted, data.episodes, numeric)
        counts = (len(set(data.episodes)), len(data.truth), sensors[modality])
        results.append(ProbeResult(probe.question, env_id, modality, probe.unit, score, (low, high), chance, *counts))
    return results


def _read(probe: Probe, path: Path, sensors: dict[str, str]) -> _Data:
    recorded = read_header(path)["episodes"]
    if len(recorded) < FEWEST_EPISODES:
        raise DemonstrationError(f"{path} holds {len(recorded)} episodes, at least {FEWEST_EPISODES} are needed; record more")
    truth, episodes = [], []
    features: dict[str, list[np.ndarray]] = {modality: [] for modality in MODALITIES}
    with open_trajectories(path) as file:
        for i, entry in enumerate(recorded):
            group = group_of(file, entry)
            for t, answer in probe.samples(group):
                truth.append(answer)
                episodes.append(i)
                for modality, rows in features.items():
                    sensor = sensors[modality]
                    try:
                        rows.append(_features(group, sensor, modality, t))
                    except KeyError as error:
                        raise DemonstrationError(
                            f"{path} lacks {modality} of {sensor} ({error}); record it with obs_mode {OBSERVED}, this "
                            "camera and the right pad"
                        ) from error
    if len(set(episodes)) < FEWEST_EPISODES:
        raise DemonstrationError(
            f"{path}: {len(set(episodes))} episodes answer {probe.question!r}, {FEWEST_EPISODES} are needed; record more"
        )
    if len(set(truth)) < 2:
        raise DemonstrationError(
            f"{path}: the answer to {probe.question!r} is {truth[0]:g} at all {len(truth)} moments; "
            "record episodes that differ in it"
        )
    stacked = {modality: np.stack(rows) for modality, rows in features.items()}
    return _Data(np.array(truth), np.array(episodes), stacked)


def cross_validated(features: np.ndarray, truth: np.ndarray, episodes: np.ndarray, numeric: bool) -> np.ndarray:
    """Predicted answers (n,), each from a fit to other episodes.

    Classes are predicted by a support vector machine, numbers by a Gaussian process, both on principal components.

    Args:
        features: Features (n, d) of the observations.
        truth: True answers (n,).
        episodes: Numbers (n,) of the episodes that the observations are from.
        numeric: Whether the answers are numbers; otherwise they are two classes.

    Raises:
        DemonstrationError: One of two classes occurs in too few episodes.
        MissingExtraError: The extra `audit`, which brings scikit-learn, is not installed.
    """
    with missing_extras_named():
        from sklearn.decomposition import PCA
        from sklearn.exceptions import ConvergenceWarning
        from sklearn.gaussian_process import GaussianProcessRegressor
        from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
        from sklearn.model_selection import GroupKFold, cross_val_predict
        from sklearn.pipeline import make_pipeline
        from sklearn.preprocessing import StandardScaler
        from sklearn.svm import SVC

    features = features[:, features.std(0) > 0]
    if not features.size:  # the sensor observes the same at all times
        features = np.zeros((len(truth), 1))
    folds = list(GroupKFold(FOLDS).split(features, truth, episodes))
    if not numeric and any(len(set(truth[learnt])) < 2 for learnt, _ in folds):
        raise DemonstrationError("one of the two answers occurs in too few episodes to predict any of them from the others")
    components = PCA(min(COMPONENTS, features.shape[1], len(truth) // 2), random_state=0)
    if numeric:
        kernel = ConstantKernel(1.0) * RBF(LENGTH_SCALE) + WhiteKernel(NOISE)
        pipeline = make_pipeline(components, GaussianProcessRegressor(kernel, normalize_y=True))
    else:
        pipeline = make_pipeline(StandardScaler(), components, SVC(C=SVM_PENALTY, class_weight="balanced"))
    # neither warning is a fault: images without change have no variance, and a fit may end at the bounds of its kernel
    with np.errstate(invalid="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        return np.asarray(cross_val_predict(pipeline, features, truth, cv=folds))


def _score(truth: np.ndarray, predicted: np.ndarray, episodes: np.ndarray, numeric: bool) -> tuple[float, float, float]:
    """Score and the ends of its 95 % interval, from a bootstrap over episodes."""
    value = (predicted - truth) ** 2 if numeric else (predicted == truth).astype(float)
    classes = np.zeros(len(truth)) if numeric else truth
    in_episode = (episodes[:, None] == np.unique(episodes)).T[:, None]
    of_class = (classes[:, None] == np.unique(classes)).T
    members = in_episode & of_class  # (episodes, classes, n)
    sums, counts = members @ value, members.sum(-1)
    drawn = np.random.default_rng(0).integers(len(members), size=(RESAMPLES, len(members)))
    drawn = np.concatenate([np.arange(len(members))[None], drawn])  # the first is the recording itself
    with np.errstate(invalid="ignore"):  # a class may be missing from a resample
        scores = np.nanmean(sums[drawn].sum(1) / counts[drawn].sum(1), axis=1)
    scores = np.sqrt(scores) if numeric else scores
    low, high = np.quantile(scores[1:], TAILS)
    return float(scores[0]), float(low), float(high)


# -------------------------------------------------------------------- table and figure


def audit_table(results: list[ProbeResult]) -> str:
    """A Markdown table with a row for each question and a column for each modality."""
    rows = []
    for group in _by_question(results):
        first = group[0]
        chance = f"{first.chance:.1f}{_suffix(first)}" if first.unit else f"{first.chance:.0%}"
        cells = [f"{_cell(first)} ({first.sensor})", *(_cell(result) for result in group[1:])]
        rows.append((short_name(first.env_id), first.question, chance, *cells))
    return markdown_table(COLUMNS_OF_TABLE, rows)


def _cell(result: ProbeResult) -> str:
    low, high = result.interval
    if result.unit:
        return f"{result.score:.1f}{_suffix(result)} [{low:.1f}, {high:.1f}]"
    return f"{result.score:.0%} [{100 * low:.0f}, {100 * high:.0f}]"


def _suffix(result: ProbeResult) -> str:
    return "°" if result.unit == "degrees" else f" {result.unit}"


def _by_question(results: list[ProbeResult]) -> Iterator[list[ProbeResult]]:
    return (results[k : k + len(MODALITIES)] for k in range(0, len(results), len(MODALITIES)))


def audited(page: Path) -> dict[str, list[str]]:
    """What the information audit found, by the names of tasks: for each question, the score of each kind of observation.

    Args:
        page: Markdown page that holds the table of `manifeel audit`.

    Raises:
        InvalidArgumentError: There is no such page, or it does not hold that table.
    """
    text = page.read_text(encoding="utf-8", errors="replace") if page.is_file() else ""
    found: dict[str, list[str]] = {}
    for head, *rows in markdown_tables(text):
        if tuple(head) == COLUMNS_OF_TABLE:
            for task, question, chance, *scores in (row for row in rows if len(row) == len(head)):
                cells = (f"{name} {shown(score)}" for name, score in zip(head[3:], scores, strict=True))
                found.setdefault(task, []).append(f'"{shown(question)}": {", ".join(cells)}, chance {shown(chance)}')
    if not found:
        raise InvalidArgumentError(f"--audit {page}: no table of `manifeel audit` is there; give the audit.md that it wrote")
    return found


def draw_figure(results: list[ProbeResult], path: Path) -> None:
    """Draw every question's scores as bars, with their intervals and chance.

    Raises:
        MissingExtraError: The extra `audit`, which brings matplotlib, is not installed.
    """
    with missing_extras_named():
        from matplotlib.figure import Figure

    groups = list(_by_question(results))
    columns = min(COLUMNS, len(groups))
    rows = math.ceil(len(groups) / columns)
    fig = Figure(figsize=(PANEL[0] * columns, PANEL[1] * rows), layout="constrained")
    places = range(len(MODALITIES))
    for k, group in enumerate(groups):
        ax = fig.add_subplot(rows, columns, k + 1)
        factor = 1 if group[0].unit else 100
        score = np.array([result.score for result in group]) * factor
        ends = np.array([result.interval for result in group]).T * factor
        ax.bar(places, score, color=COLOURS)
        ax.errorbar(places, score, np.abs(ends - score), fmt="none", ecolor="black", capsize=CAP_SIZE, lw=1)
        ax.axhline(group[0].chance * factor, color="black", ls=":", lw=1)
        ax.set_xticks(places, list(MODALITIES.values()), fontsize=FONT_SIZE)
        ax.set_ylabel(f"RMSE, {group[0].unit}" if group[0].unit else "right answers, %", fontsize=FONT_SIZE)
        ax.tick_params(axis="y", labelsize=FONT_SIZE)
        if not group[0].unit:
            ax.set_ylim(0, 100 * HEADROOM)
        ax.set_title(f"{short_name(group[0].env_id)}\n{textwrap.fill(group[0].question, TITLE_WIDTH)}", fontsize=FONT_SIZE)
    save_figure(fig, path, DPI)


@dataclass
class Args:
    """Arguments of the information audit."""

    demos: Annotated[Path, tyro.conf.arg(name="demo-path", aliases=["--demos"])] = Path("data/demos")
    """Folder with the recordings of `manifeel dataset`, a folder of each task with a trajectory file that has observations."""
    out: Path = Path("runs/audit")
    """Folder for audit.json, audit.md and audit.png."""
    camera: str | None = None
    """Camera that is asked, such as "wrist"; the policy camera of each task if not given."""


def main(args: Args) -> list[ProbeResult]:
    """Ask every question whose task has been recorded.

    Raises:
        DemonstrationError: No task with a question has been recorded.
        MissingExtraError: The extra `audit` is not installed.
    """
    with missing_extras_named():
        import sklearn  # noqa: F401  (names a missing extra before the recordings are read)
    recorded = dict(_recorded_tasks(args.demos))
    if not recorded:
        raise DemonstrationError(
            f"{args.demos} holds no <task>/trajectory.*.h5 with observations; record them with `manifeel dataset`"
        )
    asked = [(probe, spec.env_id, path) for path, spec in recorded.items() for probe in spec.probes]
    results: list[ProbeResult] = []
    with progress_bar() as bar:
        for probe, env_id, path in bar.track(asked, description="asking"):
            results += run_probe(probe, env_id, path, args.camera)
    write_json(args.out / "audit.json", [asdict(result) for result in results])
    write_text(args.out / "audit.md", table := audit_table(results))
    draw_figure(results, args.out / "audit.png")
    log.info("%s", table)
    return results


def _recorded_tasks(demos: Path) -> Iterator[tuple[Path, TaskSpec]]:
    """Trajectory files of the tasks that have questions and were recorded; the others are named in the log."""
    for spec in all_tasks().values():
        folder = demos / spec.env_id
        if spec.probes and (path := observed_file(folder, OBSERVED)):
            yield path, spec
        elif spec.probes:
            log.warning("%s is left out: %s holds no recording with observations", spec.env_id, folder)


def next_step(args: Args, _results: list[ProbeResult]) -> str:
    """What the command made, and what one can do with it."""
    trained = "`manifeel train` shows what a policy makes of it"
    return f"{args.out} has the table in audit.md, its numbers in audit.json and the figure in audit.png; {trained}"


if __name__ == "__main__":
    sys.exit(run(main, tyro.cli(Args), next_step))
