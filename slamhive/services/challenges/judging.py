"""Evaluates submissions, one at a time. Only rounded values and fixed reasons leave this module."""

from __future__ import annotations

import json
import logging
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import datetime, timedelta
from itertools import islice
from pathlib import Path

from slamhive.clock import monotonic_s, utc_now
from slamhive.domain.challenge import Failure, Format, rounded
from slamhive.errors import InvalidInput, SlamHiveError
from slamhive.evaluation.evaluators.base import KITTI_ESTIMATE, KITTI_REFERENCE
from slamhive.evaluation.job import Artefacts, EvaluationResult, EvaluationTask
from slamhive.files import write_aside
from slamhive.schema.challenge import StoredResult, StoredSubmission
from slamhive.services.challenges.definition import Definition
from slamhive.services.challenges.folder import (
    RESULT,
    ChallengeFolder,
    SubmissionFolder,
    challenge_names,
)
from slamhive.services.challenges.presets import WEIGHT
from slamhive.services.evaluations import NO_ENGINE, Evaluations, scratch_folder
from slamhive.settings import Settings

logger = logging.getLogger(__name__)

LOOK_S = 2.0
"""How often an idle worker looks for submissions."""
BATCH_SIZE = 20
ANSWERS_EVERY = timedelta(minutes=1)
"""Results are shown at full minutes: how long an evaluation takes depends on both trajectories."""


class ChallengeJudge:
    """Works through the submissions that wait.

    Args:
        settings: Where challenges are.
        evaluations: Evaluate trajectories.
        clock: The time.
    """

    def __init__(self, settings: Settings, evaluations: Evaluations, clock: Callable[[], datetime] = utc_now) -> None:
        self._settings = settings
        self._evaluations = evaluations
        self._clock = clock
        self._done: set[Path] = set()
        self._told: set[str] = set()
        self._next_look_s = 0.0

    def work_once(self, stopping: threading.Event, cores: tuple[int, ...] | None = None) -> int:
        """Evaluate submissions to one challenge, as many as one start of the engine takes; returns how many.

        They wait on if ``stopping`` is set meanwhile. Raises SlamHiveError if evaluations cannot be started.
        """
        if monotonic_s() < self._next_look_s:
            return 0
        for name in challenge_names(self._settings.challenges_folder):
            done = self._work_on(ChallengeFolder(self._settings.challenges_folder / name), stopping, cores)
            if done:
                return done
        self._next_look_s = monotonic_s() + LOOK_S
        return 0

    def _work_on(self, folder: ChallengeFolder, stopping: threading.Event, cores: tuple[int, ...] | None) -> int:
        if next(self._waiting(folder), None) is None:
            return 0
        try:
            _ = folder.definition  # one that somebody has edited may be broken
            with folder.judging() as free:
                waiting = list(islice(self._waiting(folder), BATCH_SIZE)) if free else []
                found = [entry for entry in waiting if self._readable(entry)]
                return self._judge(folder, found, stopping, cores) if found else 0
        except (FileNotFoundError, PermissionError):
            self._tell_once(folder.root.name, "this user cannot read its ground truth; run the worker as its owner")
        except InvalidInput as error:
            self._tell_once(folder.root.name, str(error))
        return 0

    def _waiting(self, folder: ChallengeFolder) -> Iterator[SubmissionFolder]:
        for submission_id in folder.submission_ids():
            found = folder.submission(submission_id)
            if found.root in self._done:
                continue
            if (found.root / RESULT).exists():
                self._done.add(found.root)
            else:
                yield found

    def _readable(self, found: SubmissionFolder) -> bool:
        """Whether its file can be read; a damaged one is left to the next worker, and holds up nobody."""
        try:
            return bool(found.sent.files)
        except SlamHiveError as error:
            self._done.add(found.root)
            logger.warning("submission %s: %s", found.root.name, error)
            return False

    def _tell_once(self, name: str, problem: str) -> None:
        if name not in self._told:
            self._told.add(name)
            logger.warning("challenge %s: %s", name, problem)

    def _judge(
        self,
        folder: ChallengeFolder,
        submissions: Sequence[SubmissionFolder],
        stopping: threading.Event,
        cores: tuple[int, ...] | None,
    ) -> int:
        with scratch_folder(self._settings.data) as scratch:
            tasks = [task for found in submissions for task in _tasks(folder, found, scratch)]
            results = {result.id: result for result in self._evaluations.measure(tasks, scratch, stopping, cores)}
        done = 0
        for found in submissions:
            sent = found.sent
            own = {name: results.get(_task_id(sent, name)) for name, facts in sent.files.items() if facts.enough}
            if None in own.values():
                continue  # the worker is stopping
            known = {name: result for name, result in own.items() if result is not None}
            result = _stored(folder.definition, sent, known, self._shown_at())
            write_aside(found.root / RESULT, json.dumps(result.content), 0o640)
            logger.info("challenge %s: submission %s is evaluated", folder.root.name, sent.id)
            done += 1
        return done

    def _shown_at(self) -> datetime:
        return self._clock().replace(second=0, microsecond=0) + ANSWERS_EVERY


def _task_id(sent: StoredSubmission, sequence: str) -> str:
    return f"{sent.id}/{sequence}"


def _tasks(folder: ChallengeFolder, found: SubmissionFolder, scratch: Path) -> Iterator[EvaluationTask]:
    for name, facts in found.sent.files.items():
        if facts.enough:
            output = scratch / "outputs" / found.sent.id / name
            output.mkdir(parents=True)
            yield _task(folder, found, name, output)


def _task(folder: ChallengeFolder, found: SubmissionFolder, name: str, output: Path) -> EvaluationTask:
    definition = folder.definition
    kitti = definition.preset.format is Format.KITTI
    return EvaluationTask(
        id=_task_id(found.sent, name),
        estimate=found.root / f"{name}.tum",
        reference=folder.secret / f"{name}.tum",
        output=output,
        protocol=definition.protocol,
        artefacts=Artefacts.METRICS,
        files={KITTI_REFERENCE: folder.secret / f"{name}.kitti", KITTI_ESTIMATE: found.root / f"{name}.kitti"}
        if kitti
        else {},
    )


def _stored(
    definition: Definition, sent: StoredSubmission, results: Mapping[str, EvaluationResult], shown_at: datetime
) -> StoredResult:
    """What is kept: rounded values, and one of the fixed reasons."""
    values: dict[str, float | None] = {}
    weights: dict[str, float] = {}
    for entry in definition.sequences_of(definition.phase(sent.phase)):
        result = results.get(entry.name)
        value = None if result is None else result.metrics.get(definition.metric.key)
        values[entry.name] = None if value is None else rounded(value, definition.file.digits)
        if result is not None and WEIGHT in result.metrics:
            weights[entry.name] = result.metrics[WEIGHT]
    failure = _failure(definition, sent, values, results)
    return StoredResult(
        shown_at=shown_at,
        values=values if failure is None else {},
        weights=weights,
        failure=None if failure is None else failure.value,
    )


def _failure(
    definition: Definition,
    sent: StoredSubmission,
    values: Mapping[str, float | None],
    results: Mapping[str, EvaluationResult],
) -> Failure | None:
    if not any(facts.enough for facts in sent.files.values()):
        return Failure.TOO_LITTLE
    if any(result.engine == NO_ENGINE for result in results.values()):
        return Failure.NO_ANSWER
    missing = [name for name, value in values.items() if value is None]
    if missing and (definition.scoring.worst is None or len(missing) == len(values)):
        return Failure.NOT_COMPARABLE
    return None
