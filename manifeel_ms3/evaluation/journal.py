"""The finished episodes of an evaluation that has not ended yet, so that an interruption loses at most the running ones.

The file `<name of the result without .json>.episodes.jsonl` lies beside the result. Its first line says what is evaluated,
every other line is the outcome of an episode and reaches the disk as soon as the episode ends. The file is deleted once the
result, which holds all of it, is written.
"""

import json
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jsonschema

from manifeel_ms3.errors import FileExistsAlreadyError, InvalidFileError
from manifeel_ms3.files import FileWriteError, write_text
from manifeel_ms3.nested_settings import differing

from .result import not_finite, result_schema
from .rollout import EpisodeOutcome, outcome_as_json, outcome_from_json

log = logging.getLogger(__name__)


class OtherEvaluationError(FileExistsAlreadyError):
    """The file holds episodes of another evaluation, which was not finished."""


class Journal:
    """The finished episodes of one evaluation.

    Args:
        result: Path of the result file.
        evaluation: Everything that the outcomes depend on, as json. An unfinished evaluation goes on if all of it is the same.
        seeds: Seeds of the episodes.
        overwrite: Discard the episodes of an unfinished evaluation.
        overwrite_other: Discard the episodes of an unfinished evaluation if it is another one, or if its file is broken.

    Raises:
        OtherEvaluationError: There is an unfinished evaluation that is another one, and it is not to be discarded.
        InvalidFileError: The file is broken.
        FileWriteError: The file cannot be written.
    """

    def __init__(
        self,
        result: Path,
        evaluation: dict[str, Any],
        seeds: list[int],
        overwrite: bool = False,
        overwrite_other: bool = False,
    ):
        name = result.name.removesuffix(".json")  # not the stem, which policy_0.3 and policy_0.5 would share
        self.path = result.with_name(f"{name}.episodes.jsonl")
        self.seeds = seeds
        self._first_line = json.dumps(evaluation | dict(seeds=seeds), default=str, allow_nan=False)
        self.outcomes: dict[int, EpisodeOutcome] = {}
        if self.path.exists() and not overwrite:
            try:
                self.outcomes = self._read()
            except (OtherEvaluationError, InvalidFileError) as error:
                if not overwrite_other:
                    raise
                log.info("the evaluation begins again, because %s", error)
        lines = [self._first_line, *map(_line_of, self.outcomes.values())]
        write_text(self.path, "".join(f"{line}\n" for line in lines))  # leaves out an incomplete last line

    @property
    def remaining(self) -> list[int]:
        """Seeds of the episodes that have not been run."""
        return [seed for seed in self.seeds if seed not in self.outcomes]

    @property
    def in_order(self) -> list[EpisodeOutcome]:
        """All outcomes in the order of the seeds."""
        return [self.outcomes[seed] for seed in self.seeds]

    def add(self, outcome: EpisodeOutcome) -> None:
        """Write the outcome of an episode to the disk.

        Raises:
            FileWriteError: The outcome cannot be written.
        """
        try:
            with self.path.open("a", encoding="utf-8") as file:
                file.write(_line_of(outcome) + "\n")
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise FileWriteError(f"{self.path} cannot be written ({error}); make room, and run the command again") from error
        self.outcomes[outcome.seed] = outcome

    @contextmanager
    def kept(self) -> Iterator[None]:
        """Context that deletes the file at its end; if an exception or Ctrl-C ends it, finished episodes stay in the file."""
        try:
            yield
        except BaseException:
            if self.outcomes:
                log.info(
                    "%d of %d episodes are finished and kept in %s; the same command goes on with the others",
                    *(len(self.outcomes), len(self.seeds), self.path),
                )
            else:
                self.path.unlink(missing_ok=True)
            raise
        self.path.unlink(missing_ok=True)

    def _read(self) -> dict[int, EpisodeOutcome]:
        try:
            whole, _, _ = self.path.read_bytes().rpartition(b"\n")  # the last line may be incomplete
            evaluation, *episodes = map(json.loads, whole.split(b"\n"))
            schema = result_schema()["properties"]["episodes"]["items"]
            for episode in episodes:
                jsonschema.validate(episode, schema)
            if place := not_finite(episodes):
                raise ValueError(f"{place} is NaN or infinite")
        except (OSError, ValueError, RecursionError, jsonschema.ValidationError) as error:
            raise InvalidFileError(
                f"{self.path} does not hold the episodes of an unfinished evaluation ({str(error).splitlines()[0]}); begin "
                "again with --overwrite, or give another --out"
            ) from error
        self._check_same(evaluation, len(episodes))
        return {episode["seed"]: outcome_from_json(episode) for episode in episodes if episode["seed"] in self.seeds}

    def _check_same(self, evaluation: Any, episodes: int) -> None:
        now, before = json.loads(self._first_line), evaluation if isinstance(evaluation, dict) else {}
        if different := [name for name, _, _ in differing(before, now)]:
            raise OtherEvaluationError(
                f"{self.path} holds {episodes} episodes of an unfinished evaluation with another {', '.join(different)}; run "
                "the command that began it, give another --out, or discard these episodes with --overwrite"
            )


def _line_of(outcome: EpisodeOutcome) -> str:
    return json.dumps(outcome_as_json(outcome), allow_nan=False)
