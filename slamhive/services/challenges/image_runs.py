"""Runs submitted images, one run at a time. Nothing of a run on a secret recording leaves its installation."""

from __future__ import annotations

import json
import logging
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from slamhive.base.clock import monotonic_s, utc_now
from slamhive.base.errors import Conflict, InvalidInput, NotFound, SlamHiveError, Unavailable
from slamhive.base.files import write_aside
from slamhive.base.settings import Settings
from slamhive.base.tree import remove_tree
from slamhive.documents.challenge import ImageRules, SequenceEntry, StoredResult, StoredRun, StoredRunsDocument
from slamhive.documents.submission import Submission
from slamhive.domain.algorithm import Algorithm
from slamhive.domain.challenge import Failure, RunFailure
from slamhive.domain.run import FailureReason, RunState
from slamhive.run_folder.outcome import read_tail
from slamhive.services.challenges.definition import (
    ENDED_RUNS,
    LOGS,
    RESULT,
    ChallengeFolder,
    SubmissionFolder,
    challenge_folder,
    challenge_names,
)
from slamhive.services.challenges.images import (
    ImageRefused,
    Installation,
    algorithm_of,
    executor_of,
    forget_image,
    link_folder,
    load_image,
)
from slamhive.services.challenges.views import shown_at
from slamhive.services.datasets import check_writable
from slamhive.store import RunRecord

logger = logging.getLogger(__name__)

# Images run in an installation of their own, which only its owner can read. All of it can be repeated after a kill:
# what is there already is not made again.

_PAGE = 500
_MOST_LOST = 3
"""A run whose end nobody knows, as after a crash of the machine, is made again until there were so many."""
LOG_BYTES = 100_000
"""So much of the end of a log is kept for the team."""


@dataclass(frozen=True)
class ImageRunsOfPhase:
    """The runs of one submission.

    Attributes:
        folder: Of the challenge.
        found: The submission.
        installation: In which its image runs.
        rules: How it runs.
    """

    folder: ChallengeFolder
    found: SubmissionFolder
    installation: Installation
    rules: ImageRules

    @property
    def sequences(self) -> list[SequenceEntry]:
        """Those of the phase, public ones first: their logs cannot know anything of the secret ones."""
        definition = self.folder.full_definition
        entries = definition.sequences_of(definition.phase(self.found.sent.phase))
        return sorted(entries, key=lambda entry: entry.secret)

    def queue(self, algorithm: Algorithm, executor: str) -> None:
        """Queue the runs that are missing. A recording that does not fit the algorithm gets none."""
        known = {(run.dataset, run.seed) for run in self.all()}
        for entry in self.sequences:
            source = self.folder.recording(entry.name)
            link_folder(source, self.installation.settings.datasets_folder / entry.name)
            for seed in self.seeds:
                if (entry.name, seed) in known:
                    continue
                try:
                    self.installation.runs.submit(
                        Submission(
                            algorithm.label,
                            entry.name,
                            executor=executor,
                            seed=seed,
                            playback_mode=self.rules.playback,
                            playback_rate=self.rules.rate,
                            evaluate=False,
                            cpu_cores=self.rules.cpu_cores,
                            memory_mb=self.rules.memory_mb,
                            timeout_s=self.rules.time_limit_s,
                        )
                    )
                except (InvalidInput, NotFound):
                    break  # it will not fit with another seed either

    @property
    def seeds(self) -> range:
        """Of the runs on each sequence."""
        return range(self.rules.seed, self.rules.seed + self.rules.repeats)

    def all(self) -> list[RunRecord]:
        """All runs, the first one first; those that were made again, too."""
        found: list[RunRecord] = []
        after: str | None = None
        while True:
            page = self.installation.runs.page(after=after, limit=_PAGE)
            found += page.records
            after = page.next_key
            if after is None:
                return sorted(found, key=lambda run: run.id)

    def next(self) -> RunRecord | None:
        """The run to work on; None if all have ended for good."""
        runs = self.all()
        for run in runs:
            if not run.state.ended:
                return run
        for attempts in self._attempts(runs):
            if attempts and attempts[-1].reason is FailureReason.LOST and len(attempts) < _MOST_LOST:
                return self.installation.runs.retry(attempts[-1].id)
        return None

    def _attempts(self, runs: Sequence[RunRecord]) -> Iterator[list[RunRecord]]:
        """The runs for each sequence and seed."""
        for entry in self.sequences:
            for seed in self.seeds:
                yield [run for run in runs if (run.dataset, run.seed) == (entry.name, seed)]

    def finish(self) -> None:
        """Keep how all runs have ended, and what those on public recordings have printed."""
        entries = {entry.name: entry for entry in self.sequences}
        names = [entry.name for entry in self.sequences for _ in self.seeds]
        ended = []
        for name, attempts in zip(names, self._attempts(self.all()), strict=True):
            run = attempts[-1] if attempts else None
            ended.append(StoredRun(sequence=name, run=None if run is None else run.id, failure=_failure(run)))
            if run is not None and not entries[name].secret:
                text = read_tail(self.installation.runs.folder(run.id).log, LOG_BYTES)
                said = f"{run.state}: {run.detail}\n" if run.detail else f"{run.state}\n"
                logs = self.found.root / LOGS
                logs.mkdir(mode=0o750, exist_ok=True)
                number = run.seed - self.rules.seed + 1
                label = name if self.rules.repeats == 1 else f"{name}-{number}"
                # Nothing that could steer a terminal.
                kept = "".join(character for character in text + said if character.isprintable() or character in "\n\t")
                write_aside(logs / f"{label}.txt", kept, 0o640)
        content = json.dumps(StoredRunsDocument(runs=tuple(ended)).content)
        write_aside(self.folder.installation(self.found.root.name) / ENDED_RUNS, content, 0o600)

    def cancel(self) -> list[RunRecord]:
        """Cancel the runs that have not ended; those that a worker still has to end."""
        left = [run for run in self.all() if not run.state.ended]
        return [run for run in map(self.installation.runs.cancel, (run.id for run in left)) if not run.state.ended]


def _failure(run: RunRecord | None) -> str | None:
    if run is None:
        return RunFailure.NOT_FITTING.value
    return None if run.state is RunState.SUCCEEDED else RunFailure.of(run.reason).value


LOOK_S = 2.0
"""How often an idle worker looks for images."""
TROUBLE_S = 30.0
"""When it tries again after engine, database or disk have refused; other work goes on meanwhile."""
WATCH_S = 0.5
"""How often it looks whether a submission was cancelled."""
SETTLE_S = 60.0
"""What a run may take besides its time limit, to be prepared and collected, before others can see how long it took."""


class ImageWork:
    """Works through the images that wait.

    Args:
        settings: Where challenges are.
        opened: Opens the installation in a folder.
        clock: The time.
    """

    def __init__(
        self, settings: Settings, opened: Callable[[Path], Installation], clock: Callable[[], datetime] = utc_now
    ) -> None:
        self._settings = settings
        self._opened = opened
        self._clock = clock
        self._done: set[Path] = set()
        self._told: set[tuple[str, str]] = set()
        self._next_look_s = 0.0

    def work_once(self, stopping: threading.Event, cores: tuple[int, ...] | None = None) -> int:
        """Load one image, do one of its runs, or note that all have ended; returns whether there was anything to do.

        What engine, database or disk refuse is tried again later.
        """
        if monotonic_s() < self._next_look_s:
            return 0
        pause_s = LOOK_S
        for name in challenge_names(self._settings.challenges_folder):
            try:
                if self._work_on(ChallengeFolder(self._settings.challenges_folder / name), stopping, cores):
                    return 1
            except SlamHiveError as error:
                self._tell_once(name, str(error))
                pause_s = TROUBLE_S
        self._next_look_s = monotonic_s() + pause_s
        return 0

    def remove(self, name: str) -> None:
        """Remove a challenge with all that belongs to it, and its images from the engine.

        Raises NotFound, Conflict while one of its images runs, and Unavailable if the engine or the disk refuses.
        """
        check_writable(self._settings)
        folder = challenge_folder(self._settings.challenges_folder, name)
        try:
            with folder.running() as free:
                if not free:
                    raise Conflict(f"an image of challenge {name} runs", "stop the worker, then try again")
                for submission_id in folder.submission_ids():
                    root = folder.installation(submission_id)
                    if root.is_dir() and folder.ended_runs(submission_id) is None:
                        # End what it still runs, and forget its image.
                        found = folder.submission(submission_id)
                        with closing(self._opened(root)) as installation:
                            rules = folder.full_definition.file.images
                            assert rules is not None  # it has an installation
                            runs = ImageRunsOfPhase(folder, found, installation, rules)
                            for run in runs.cancel():
                                self._drive(runs, run, threading.Event(), None)
                            forget_image(installation)
                aside = folder.root.with_name(f".{name}")
                folder.root.rename(aside)
                remove_tree(aside)
        except OSError as error:
            raise Unavailable(f"{folder.root} cannot be removed: {error.strerror}", "remove it as its owner") from None

    def _work_on(self, folder: ChallengeFolder, stopping: threading.Event, cores: tuple[int, ...] | None) -> bool:
        try:
            if next(self._waiting(folder), None) is None:
                return False
            with folder.running() as free:
                found = next(self._waiting(folder), None) if free else None
                if found is not None:
                    self._advance(folder, found, stopping, cores)
                return found is not None
        except (FileNotFoundError, PermissionError):
            self._tell_once(folder.root.name, "this user cannot read its recordings; run the worker as its owner")
        return False

    def _waiting(self, folder: ChallengeFolder) -> Iterator[SubmissionFolder]:
        for submission_id in folder.submission_ids():
            found = folder.submission(submission_id)
            if found.root in self._done:
                continue
            if (found.root / RESULT).exists() or self._is_over(folder, found):
                self._done.add(found.root)
            else:
                yield found

    def _is_over(self, folder: ChallengeFolder, found: SubmissionFolder) -> bool:
        """Tell if there is nothing to run; a damaged submission is left to the next worker, and holds up nobody."""
        try:
            return found.sent.image is None or folder.ended_runs(found.root.name) is not None
        except SlamHiveError as error:
            logger.warning("submission %s: %s", found.root.name, error)
            return True

    def _tell_once(self, name: str, problem: str) -> None:
        if (name, problem) not in self._told:
            self._told.add((name, problem))
            logger.warning("challenge %s: %s", name, problem)

    def _advance(
        self,
        folder: ChallengeFolder,
        found: SubmissionFolder,
        stopping: threading.Event,
        cores: tuple[int, ...] | None,
    ) -> None:
        rules = folder.full_definition.file.images
        assert rules is not None  # no phase took an image otherwise
        root = folder.installation(found.root.name)
        root.mkdir(mode=0o700, parents=True, exist_ok=True)
        with closing(self._opened(root)) as installation:
            runs = ImageRunsOfPhase(folder, found, installation, rules)
            if found.cancelled:
                for cancelled in runs.cancel():
                    self._drive(runs, cancelled, stopping, cores)
                    if stopping.is_set():
                        return
                forget_image(installation)
                self._end(found, Failure.CANCELLED.value)
                return
            try:
                version = load_image(installation, found, self._settings.versions_folder)
                assert found.sent.image is not None
                algorithm = algorithm_of(installation, version, found.sent.image, rules)
            except ImageRefused as error:
                self._end(found, str(error))
                forget_image(installation)
                return
            runs.queue(algorithm, executor_of(installation).name)
            run = runs.next()
            if run is None:
                runs.finish()
                forget_image(installation)
                logger.info("challenge %s: the runs of submission %s have ended", folder.root.name, found.root.name)
            else:
                self._do(runs, run, stopping, cores)

    def _do(
        self,
        runs: ImageRunsOfPhase,
        run: RunRecord,
        stopping: threading.Event,
        cores: tuple[int, ...] | None,
    ) -> None:
        """Take one run to its end, and with constant time keep the slot for as long as the longest run."""
        began = run.started_at or self._clock()
        self._drive(runs, run, stopping, cores)
        if not runs.rules.constant_time:
            return
        ends_s = runs.rules.time_limit_s + SETTLE_S
        while (self._clock() - began).total_seconds() < ends_s and not runs.found.cancelled:
            if stopping.wait(WATCH_S):
                return

    def _drive(
        self, runs: ImageRunsOfPhase, run: RunRecord, stopping: threading.Event, cores: tuple[int, ...] | None
    ) -> None:
        worker = runs.installation.worker([run.id])

        def look() -> None:
            if stopping.is_set():
                worker.stop()
            elif runs.found.cancelled:
                runs.cancel()

        with _meanwhile(look):
            worker.run(until_idle=True, cores=cores)

    def _end(self, found: SubmissionFolder, failure: str) -> None:
        """Keep why an image has no runs. That can be shown soon, since it has seen no recording."""
        result = StoredResult(shown_at=shown_at(self._clock(), None), values={}, weights={}, failure=failure)
        write_aside(found.root / RESULT, json.dumps(result.content), 0o640)
        logger.info("challenge: submission %s has no runs: %s", found.root.name, failure)


@contextmanager
def _meanwhile(look: Callable[[], None]) -> Iterator[None]:
    """Call ``look`` again and again during the block, in a thread of its own."""
    ends = threading.Event()

    def work() -> None:
        while not ends.wait(WATCH_S):
            try:
                look()
            except (SlamHiveError, OSError) as error:
                logger.info("looking after the runs of an image: %s", error)

    thread = threading.Thread(target=work, name="image-watch", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ends.set()
        thread.join()
