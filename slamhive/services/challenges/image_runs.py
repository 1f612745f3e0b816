"""The runs of one image on the recordings of a phase, in an installation of their own that only its owner can read.

All of it can be repeated after a kill: what is there already is not made again.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from slamhive.domain.algorithm import Algorithm
from slamhive.domain.challenge import RunFailure
from slamhive.domain.run import FailureReason, RunState
from slamhive.errors import InvalidInput, NotFound
from slamhive.files import write_aside
from slamhive.runs.log_line import read_tail
from slamhive.schema.challenge import ImageRules, SequenceEntry, StoredRun, StoredRuns
from slamhive.schema.submission import Submission
from slamhive.services.challenges.folder import ENDED_RUNS, LOGS, ChallengeFolder, SubmissionFolder
from slamhive.services.challenges.image_loading import Installation
from slamhive.services.challenges.recordings import link_folder
from slamhive.store import RunRecord

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
                if (entry.name, seed) not in known and not self._submitted(algorithm, executor, entry.name, seed):
                    break

    def _submitted(self, algorithm: Algorithm, executor: str, sequence: str, seed: int) -> bool:
        rules = self.rules
        try:
            self.installation.runs.submit(
                Submission(
                    algorithm.label,
                    sequence,
                    executor=executor,
                    seed=seed,
                    playback_mode=rules.playback,
                    playback_rate=rules.rate,
                    evaluate=False,
                    cpu_cores=rules.cpu_cores,
                    memory_mb=rules.memory_mb,
                    timeout_s=rules.time_limit_s,
                )
            )
        except (InvalidInput, NotFound):
            return False
        return True

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
                self._keep_log(run)
        content = json.dumps(StoredRuns(runs=tuple(ended)).content)
        write_aside(self.folder.installation(self.found.root.name) / ENDED_RUNS, content, 0o600)

    def _keep_log(self, run: RunRecord) -> None:
        text = read_tail(self.installation.runs.folder(run.id).log, LOG_BYTES)
        said = f"{run.state}: {run.detail}\n" if run.detail else f"{run.state}\n"
        logs = self.found.root / LOGS
        logs.mkdir(mode=0o750, exist_ok=True)
        number = run.seed - self.rules.seed + 1
        name = run.dataset if self.rules.repeats == 1 else f"{run.dataset}-{number}"
        write_aside(logs / f"{name}.txt", _without_controls(text + said), 0o640)

    def cancel(self) -> list[RunRecord]:
        """Cancel the runs that have not ended; those that a worker still has to end."""
        left = [run for run in self.all() if not run.state.ended]
        return [run for run in map(self.installation.runs.cancel, (run.id for run in left)) if not run.state.ended]


def _failure(run: RunRecord | None) -> str | None:
    if run is None:
        return RunFailure.NOT_FITTING.value
    return None if run.state is RunState.SUCCEEDED else RunFailure.of(run.reason).value


def _without_controls(text: str) -> str:
    """``text`` without what could steer a terminal."""
    return "".join(character for character in text if character.isprintable() or character in "\n\t")
