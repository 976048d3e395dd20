"""Evaluation of checkpoints in a separate process while training goes on."""

import logging
import os
import subprocess
import sys
import time
from collections import deque
from pathlib import Path

from manifeel_ms3.evaluation.result import MEANS, RATES, read_result
from manifeel_ms3.typed_modules import MODULES, imported

log = logging.getLogger(__name__)
SUCCESS = "eval/success_once"
"""Scalar that every evaluation logs."""
NOT_FROM_HERE = ["-P"] if sys.version_info >= (3, 11) else []
"""Option of Python that keeps `-m` from searching the current folder for modules, where a stranger's torch.py may lie."""


class BackgroundEvaluation:
    """Evaluates checkpoints one after another; a failed evaluation is logged and does not stop the training.

    Args:
        folder: Folder of the results, <step>.json, and of the evaluations' output, <step>.log.
        episodes: Number of episodes for each checkpoint.
        workers: Number of processes of an evaluation.
        env_kwargs: Arguments of the task, as a json object.
        device: Device of the policy; if not given, a GPU where there is one.
        video: Whether the first episode is recorded as a video, videos/step_<step>.mp4 in the folder.
    """

    def __init__(
        self, folder: Path, episodes: int, workers: int, env_kwargs: str, device: str | None = None, video: bool = False
    ):
        self.folder = folder
        self._arguments = ["--num-eval-episodes", str(episodes), "--num-eval-envs", str(workers), "--env-kwargs", env_kwargs]
        self._arguments += [] if device is None else ["--device", device]
        self._arguments += ["--videos", "0"] if video else []
        self._waiting: deque[Path] = deque()
        self._running: tuple[Path, subprocess.Popen] | None = None
        self._began = 0  # ns since the epoch, of the evaluation that is running

    @property
    def in_use(self) -> set[Path]:
        """Checkpoints that are being evaluated or wait for it, and must not be deleted."""
        return {*self._waiting, *([self._running[0]] if self._running else [])}

    def submit(self, checkpoint: Path) -> None:
        """Queue a checkpoint."""
        self._waiting.append(checkpoint)

    def finished(self, wait: bool = False) -> list[dict[str, float]]:
        """Start the next evaluation if none is running, and return the results that finished since the last call.

        Args:
            wait: Whether to wait until all queued checkpoints have been evaluated.

        Returns:
            For each checkpoint its "step", and its rates and means under ManiSkill's names, such as "eval/success_once".
        """
        rates: list[dict[str, float]] = []
        while self._running or self._waiting:
            checkpoint, process = self._running = self._running or self._start(self._waiting.popleft())
            if wait:
                process.wait()
            if process.poll() is None:
                break
            self._running = None
            rates += self._read(checkpoint, process.returncode)
        return rates

    def _start(self, checkpoint: Path) -> tuple[Path, subprocess.Popen]:
        self.folder.mkdir(parents=True, exist_ok=True)
        self._began = time.time_ns()
        result = self._result(checkpoint).absolute()
        command = [sys.executable, *NOT_FROM_HERE, "-m", "manifeel_ms3.evaluation.evaluate"]
        # an interrupted run may have evaluated another checkpoint of this step
        command += ["--checkpoint", str(checkpoint.absolute()), "--out", str(result), "--overwrite-other", *self._arguments]
        modules = imported()  # of tasks that were typed with their module, which a checkpoint does not name
        folder = None if NOT_FROM_HERE or modules else self.folder  # a folder that only this package writes into
        environment = os.environ | {MODULES: ",".join(modules)}
        environment |= dict(PYTHONSAFEPATH="1")  # the same as NOT_FROM_HERE for the processes that the evaluation starts
        with result.with_suffix(".log").open("w") as output:
            return checkpoint, subprocess.Popen(command, cwd=folder, env=environment, stdout=output, stderr=output)

    def _read(self, checkpoint: Path, code: int) -> list[dict[str, float]]:
        path = self._result(checkpoint)
        if code != 0:
            made = path.is_file() and path.stat().st_mtime_ns > self._began
            what = "a part of the evaluation" if made else "the evaluation"
            log.warning("%s of %s failed; %s says why", what, checkpoint, path.with_suffix(".log"))
            if not made:
                return []
        step, result = int(checkpoint.name), read_result(path)
        if (video := self.folder / "videos" / f"{result['episodes'][0]['seed']}.mp4").is_file():
            video.replace(self._video(step))  # the next evaluation records the same episode
        scalars: dict[str, float] = {name: result[name]["rate"] for name in RATES if name in result} | {
            name: result[name] for name in MEANS
        }
        return [{"step": step, **{f"eval/{name}": value for name, value in scalars.items()}}]

    def stop(self) -> None:
        """End the evaluation that is running, which continues where it stopped when its checkpoint is submitted again."""
        if self._running:
            self._running[1].kill()
            self._running[1].wait()

    def video_of(self, step: int) -> Path | None:
        """The video of a checkpoint's evaluation; None if there is none."""
        path = self._video(step)
        return path if path.is_file() else None

    def _video(self, step: int) -> Path:
        """Path of the video of a checkpoint's evaluation, which no seed has as its name."""
        return self.folder / "videos" / f"step_{step}.mp4"

    def _result(self, checkpoint: Path) -> Path:
        return self.folder / f"{checkpoint.name}.json"
