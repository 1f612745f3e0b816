"""Replays in one installation: what a bundle needs is found, its runs are repeated and compared with the record."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import asdict

from slamhive.base.errors import InvalidInput, NotFound, SlamHiveError
from slamhive.base.settings import Settings
from slamhive.documents.gate import BaselineConfiguration, ReplayAnswer
from slamhive.documents.record import ConfigurationContent
from slamhive.documents.submission import Submission
from slamhive.domain.gate import REPLAY_MARGINS, chosen_margins
from slamhive.domain.names import plural
from slamhive.domain.packages import version_label
from slamhive.executors.base import Executor
from slamhive.services.archive import ArchiveImport, ArchiveReader, open_archive
from slamhive.services.datasets import Catalogue, check_writable
from slamhive.services.executors import Executors
from slamhive.services.gates import frozen_configuration, pairing_key
from slamhive.services.replay.needs import Needs, Packages, Prepared, Recorded, Recordings, ReplayRequest, needs_of
from slamhive.services.runs import RunService
from slamhive.services.versions import Versions
from slamhive.store import RunRecord, Store, Transaction

Progress = Callable[[float, str], None]
"""Called with the share done (0..1) and what is being done."""
Group = tuple[RunRecord, ...]


class Replays:
    """Repeats the runs of bundles.

    Args:
        settings: Mode and data root.
        store: The runs.
        catalogue: Algorithms and datasets that are here.
        runs: Submits runs.
        versions: Knows, loads and builds versions.
        executors: Run them.
    """

    def __init__(
        self,
        settings: Settings,
        store: Store,
        catalogue: Catalogue,
        runs: RunService,
        versions: Versions,
        executors: Executors,
    ) -> None:
        self._settings = settings
        self._store = store
        self._catalogue = catalogue
        self._runs = runs
        self._versions = versions
        self._executors = executors

    def prepare(self, request: ReplayRequest, progress: Progress) -> Prepared:
        """Import the recorded runs, and make sure that all that they need is here.

        What the bundle refers to is looked for first. Raises InvalidInput or NotFound, with nothing changed, if a
        recording is missing or another one; then as importing an archive does, and as :meth:`Packages.get`.
        """
        check_writable(self._settings)
        with open_archive(request.path) as archive:
            needs = needs_of(archive)
            recordings = Recordings(self._catalogue, archive, needs.datasets)
            lacking = recordings.check()
            report = ArchiveImport(self._settings, self._store, self._catalogue).carry_out(request.path, progress)
            recordings.place(lacking, progress)
            notes = [f"{plural(count, 'recorded run')} left out: {reason}." for reason, count in needs.left_out.items()]
            configurations = self._configurations(archive, request, needs, notes, progress)
        measured = frozenset(
            key for entry in configurations for run in entry.held.runs if run.failed is None for key in run.metrics
        )
        margins = chosen_margins(request.margins, measured, REPLAY_MARGINS)
        return Prepared(request, margins, configurations, (*notes, *report.notes))

    def start(self, prepared: Prepared) -> list[list[int]]:
        """Queue the repeats of each configuration, with the seeds of its recorded runs; all or none. Their numbers."""
        queued: list[list[int]] = []
        try:
            for entry in prepared.configurations:
                queued.append([])
                for number in range(prepared.request.repeats):
                    recorded = entry.runs[number % len(entry.runs)]
                    submission = _submission(entry, recorded.seed)
                    queued[-1] += [run.id for run in self._runs.submit(submission, entry.held.protocol)]
        except SlamHiveError:
            for run_id in (run_id for run_ids in queued for run_id in run_ids):
                self._runs.cancel(run_id)
            raise
        return queued

    def answer(self, prepared: Prepared, run_ids: Sequence[Sequence[int]]) -> ReplayAnswer:
        """Compare the repeats that :meth:`start` has queued, once they have ended, with the record.

        Raises InvalidInput if one was cancelled, was not evaluated, or ran another version than it should.
        """
        from slamhive.services.replay.answer import answer_of  # noqa: PLC0415 - loads scipy

        def work(t: Transaction) -> ReplayAnswer:
            repeats = [t.runs.get_many(numbers) for numbers in run_ids]
            return answer_of(t, prepared, repeats, self._settings.runs_folder)

        return self._store.read(work)

    def _configurations(
        self, archive: ArchiveReader, request: ReplayRequest, needs: Needs, notes: list[str], progress: Progress
    ) -> tuple[Recorded, ...]:
        packages = Packages(
            self._versions, archive, request, self._settings.versions_folder, lambda line: progress(1.0, line)
        )
        found = []
        for held, runs in self._store.read(lambda t: _recorded(t, needs.uids, notes)):
            version = runs[0].version
            assert version is not None
            executor = self._executor(request, runs[0].executor)
            record = packages.get(runs[0].package, version, executor)
            found.append(Recorded(held, runs, record, executor.name))
        if not found:
            raise InvalidInput(
                f"nothing of the bundle can be replayed. {' '.join(notes)}", "evaluate it, and export it"
            )
        return tuple(found)

    def _executor(self, request: ReplayRequest, recorded: str) -> Executor:
        """The executor that was asked for, else that of the record if it can be used here, else the one in force."""
        if request.executor is None:
            try:
                found = self._executors.get(recorded)
                if found.unavailable_because() is None:
                    return found
            except NotFound:
                pass  # that of a plug-in which is not here
        return self._executors.get(self._executors.choose(request.executor))


def _recorded(t: Transaction, uids: Sequence[str], notes: list[str]) -> list[tuple[BaselineConfiguration, Group]]:
    """The configurations of these runs, each with one version; a note for each that cannot be compared."""
    protocols = {protocol.fingerprint: protocol for protocol, _ in t.evaluations.protocols()}
    groups: dict[tuple[str, str, str], list[RunRecord]] = defaultdict(list)
    for run in t.runs.get_many(sorted(t.runs.ids_by_uid(uids).values())):
        if run.version is not None:
            version = run.version.identity, run.version.package_hash
            groups[pairing_key(ConfigurationContent.of(run)), *version].append(run)
    found = []
    for runs in groups.values():
        words = f"{plural(len(runs), 'recorded run')} of {runs[0].algorithm} on {runs[0].dataset} left out"
        try:
            held = frozen_configuration(t, runs, protocols)
        except InvalidInput as error:
            notes.append(f"{words}: {error.message}.")
            continue
        if held is None:
            notes.append(f"{words}: not evaluated.")
            continue
        kept = {run.uid for run in held.runs}
        found.append((held, tuple(run for run in runs if run.uid in kept)))
    return found


def _submission(entry: Recorded, seed: int) -> Submission:
    """The recorded configuration in the version that is here, with the limits of its first run."""
    held, first = entry.held, entry.runs[0]
    return Submission(
        version_label(held.algorithm, entry.version.number),
        held.dataset,
        dict(held.parameters),
        executor=entry.executor,
        seed=seed,
        playback_mode=held.playback.mode,
        playback_rate=held.playback.rate,
        **asdict(first.limits),
        variant=held.variant,
        sensors=held.sensors,
        map=None if held.map is None else held.map.run,
    )
