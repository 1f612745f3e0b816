"""Evaluates submissions, one at a time. Only rounded values and fixed reasons leave this module."""

from __future__ import annotations

import json
import logging
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import datetime
from itertools import islice
from pathlib import Path

from slamhive.base.clock import monotonic_s, utc_now
from slamhive.base.errors import InvalidInput, SlamHiveError
from slamhive.base.files import write_aside
from slamhive.base.settings import Settings
from slamhive.documents.challenge import StoredResult, StoredSubmission
from slamhive.domain.challenge import Failure, RunFailure, rounded
from slamhive.evaluation.evaluators.base import KITTI_ESTIMATE, KITTI_REFERENCE
from slamhive.evaluation.job import Artefacts, EvaluationResult, EvaluationTask
from slamhive.services.challenges.checking import Estimate, Estimates, estimates_of
from slamhive.services.challenges.definition import (
    RESULT,
    WEIGHT,
    ChallengeFolder,
    Definition,
    SubmissionFolder,
    challenge_names,
)
from slamhive.services.challenges.views import shown_at
from slamhive.services.evaluations import NO_ENGINE, Evaluations, scratch_folder

logger = logging.getLogger(__name__)

LOOK_S = 2.0
"""How often an idle worker looks for submissions."""
BATCH_SIZE = 20


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
            _ = folder.full_definition  # one that somebody has edited may be broken
            with folder.judging() as free:
                ready = (entry for entry in self._waiting(folder) if self._ready(folder, entry))
                found = list(islice(ready, BATCH_SIZE)) if free else []
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

    def _ready(self, folder: ChallengeFolder, found: SubmissionFolder) -> bool:
        """Tell if there are trajectories; a damaged one is left to the next worker, and holds up nobody."""
        try:
            if found.sent.image is not None:
                return folder.ended_runs(found.root.name) is not None
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
        known = {found.root: estimates_of(folder, found) for found in submissions if not found.cancelled}
        with scratch_folder(self._settings.data) as scratch:
            tasks = [_task(folder, entry, scratch) for made in known.values() for entry in made.found]
            results = {result.id: result for result in self._evaluations.measure(tasks, scratch, stopping, cores)}
        done = 0
        for found in submissions:
            made = known.get(found.root, Estimates())
            if any(entry.id not in results for entry in made.found):
                continue  # the worker is stopping
            result = self._result(folder.full_definition, found, made, results)
            write_aside(found.root / RESULT, json.dumps(result.content), 0o640)
            logger.info("challenge %s: submission %s is evaluated", folder.root.name, found.root.name)
            done += 1
        return done

    def _result(
        self,
        definition: Definition,
        found: SubmissionFolder,
        made: Estimates,
        results: Mapping[str, EvaluationResult],
    ) -> StoredResult:
        rules = definition.file.images if found.sent.image is not None else None
        at = shown_at(self._clock(), None if rules is None else rules.answers_every_h)
        if found.cancelled:
            return StoredResult(shown_at=at, values={}, weights={}, failure=Failure.CANCELLED.value)
        return _stored(definition, found.sent, made, results, at)


def _task(folder: ChallengeFolder, estimate: Estimate, scratch: Path) -> EvaluationTask:
    output = scratch / "outputs" / estimate.id
    output.mkdir(parents=True)
    files = {}
    if estimate.frames is not None:
        files = {KITTI_REFERENCE: folder.secret / f"{estimate.sequence}.kitti", KITTI_ESTIMATE: estimate.frames}
    return EvaluationTask(
        id=estimate.id,
        estimate=estimate.path,
        reference=folder.secret / f"{estimate.sequence}.tum",
        output=output,
        protocol=folder.full_definition.protocol,
        artefacts=Artefacts.METRICS,
        files=files,
    )


def _stored(
    definition: Definition,
    sent: StoredSubmission,
    made: Estimates,
    results: Mapping[str, EvaluationResult],
    at: datetime,
) -> StoredResult:
    """Make the stored result: rounded values, and some of the fixed reasons."""
    values: dict[str, float | None] = {}
    weights: dict[str, float] = {}
    reasons: dict[str, str] = {}
    for entry in definition.sequences_of(definition.phase(sent.phase)):
        own = [results[estimate.id] for estimate in made.found if estimate.sequence == entry.name]
        failures = made.failures.get(entry.name, [])
        found = [result.metrics.get(definition.metric.key) for result in own]
        value = middle([*found, *(None for _ in failures)], higher_is_better=definition.scoring.higher_is_better)
        values[entry.name] = None if value is None else rounded(value, definition.file.digits)
        for result in own:
            if WEIGHT in result.metrics:
                weights[entry.name] = result.metrics[WEIGHT]
        if value is None and sent.image is not None:
            reasons[entry.name] = (*failures, RunFailure.NOT_COMPARABLE)[0].value
    failure = _failure(definition, made, values, [results[entry.id] for entry in made.found])
    if failure is not None and sent.image is not None and not made.found:
        failure = Failure.NO_RUN
    return StoredResult(
        shown_at=at,
        values=values if failure is None else {},
        weights=weights,
        failure=None if failure is None else failure.value,
        reasons=reasons,
    )


def middle(values: Sequence[float | None], *, higher_is_better: bool) -> float | None:
    """The median, where a missing value is worse than all others; of two in the middle, the worse one."""
    known = sorted((value for value in values if value is not None), reverse=higher_is_better)
    place = len(values) // 2
    return known[place] if place < len(known) else None


def _failure(
    definition: Definition,
    made: Estimates,
    values: Mapping[str, float | None],
    results: Sequence[EvaluationResult],
) -> Failure | None:
    if not made.found:
        return Failure.TOO_LITTLE
    if any(result.engine == NO_ENGINE for result in results):
        return Failure.NO_ANSWER
    missing = [name for name, value in values.items() if value is None]
    if missing and (definition.scoring.worst is None or len(missing) == len(values)):
        return Failure.NOT_COMPARABLE
    return None
