"""Checkpoints are evaluated in a process of their own, while training goes on."""

import json
import logging
import subprocess
import sys
from collections import deque
from pathlib import Path

log = logging.getLogger(__name__)


class BackgroundEvaluation:
    """Evaluates checkpoints one after the other, into `folder`/<step>.json; what fails is reported and left out."""

    def __init__(self, folder: Path, episodes: int, workers: int, env_kwargs: str):
        self.folder = folder
        self._arguments = ["--episodes", str(episodes), "--workers", str(workers), "--env-kwargs", env_kwargs]
        self._waiting: deque[Path] = deque()
        self._running: tuple[Path, subprocess.Popen] | None = None

    @property
    def in_use(self) -> set[Path]:
        """Checkpoints that must stay."""
        return {*self._waiting, *([self._running[0]] if self._running else [])}

    def submit(self, checkpoint: Path) -> None:
        self._waiting.append(checkpoint)

    def finished(self, wait: bool = False) -> list[dict[str, float]]:
        """Success rates, of what has been evaluated since the last call; starts the next."""
        rates = []
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
        command = [sys.executable, "-m", "manifeel_ms3.evaluation.evaluate", "--checkpoint", str(checkpoint)]
        command += ["--out", str(self._result(checkpoint)), *self._arguments]
        with self._result(checkpoint).with_suffix(".log").open("w") as output:
            return checkpoint, subprocess.Popen(command, stdout=output, stderr=output)

    def _read(self, checkpoint: Path, code: int) -> list[dict[str, float]]:
        path = self._result(checkpoint)
        if code != 0:
            log.warning("evaluating %s failed; %s says why", checkpoint, path.with_suffix(".log"))
            return []
        return [dict(evaluated_step=int(checkpoint.name), success_once=json.loads(path.read_text())["success_once"]["rate"])]

    def _result(self, checkpoint: Path) -> Path:
        return self.folder / f"{checkpoint.name}.json"
