"""The current protocol of a run, whose metrics are shown: its first, until the user chooses another."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from slamhive.domain.protocol import Protocol
from slamhive.domain.protocol_request import ProtocolRequest
from slamhive.domain.trajectory_kind import with_trajectory
from slamhive.errors import Conflict
from slamhive.runs.folder import RunFolder
from slamhive.services.evaluations.service import Evaluations
from slamhive.store import Store
from slamhive.store.records import EvaluationRecord, ProtocolLabel, RunRecord


class CurrentProtocols:
    """Chooses the current protocol of runs, in the database and in their folders.

    Args:
        store: Runs and metrics.
        evaluations: Resolves a protocol request for a run.
        runs_folder: The run folders.
    """

    def __init__(self, store: Store, evaluations: Evaluations, runs_folder: Path) -> None:
        self._store = store
        self._evaluations = evaluations
        self._runs_folder = runs_folder

    def figures(self, run_id: int) -> dict[str, dict[str, float]]:
        """The metrics of a run under each protocol: {fingerprint: {metric key: value}}."""
        found = self._store.read(lambda t: t.metrics.by_protocol(run_id))
        return {fingerprint: values for fingerprint, values in found.items() if fingerprint is not None}

    def use(self, run_ids: Iterable[int], fingerprint: str) -> None:
        """Make a protocol the current one of these runs: lists, searches and pages show its metrics.

        Raises NotFound for an unknown protocol, Conflict for a run without metrics under it; nothing is changed then.
        """
        wanted = list(run_ids)
        self._store.write(lambda t: t.evaluations.use(wanted, fingerprint))
        for run_id in wanted:
            RunFolder(self._runs_folder / str(run_id)).write_current_protocol(fingerprint)

    def use_asked(self, run_ids: Iterable[int], asked: ProtocolRequest) -> None:
        """As :meth:`use`, with the protocol that the request means for each run."""
        runs = self._store.read(lambda t: t.runs.get_many(run_ids))
        chosen = [(run.id, self._evaluations.protocol_of(run, asked).fingerprint) for run in runs]
        for run_id, fingerprint in chosen:
            if fingerprint not in self.figures(run_id):
                raise Conflict(f"run {run_id} has no metrics under protocol {asked.name}", "evaluate it first")
        self._use_each(chosen)

    def make_current(self, ended: Iterable[EvaluationRecord]) -> None:
        """As :meth:`use`, for ended evaluations; failed ones change nothing."""
        self._use_each((entry.run_id, entry.protocol.fingerprint) for entry in ended if entry.reason is None)

    def _use_each(self, chosen: Iterable[tuple[int, str]]) -> None:
        by_fingerprint: dict[str, list[int]] = defaultdict(list)
        for run_id, fingerprint in chosen:
            by_fingerprint[fingerprint].append(run_id)
        for fingerprint, run_ids in by_fingerprint.items():
            self.use(run_ids, fingerprint)

    def as_evaluated(self, ended: Iterable[EvaluationRecord]) -> list[RunRecord]:
        """The runs of these evaluations, in order, each with the metrics of its evaluation."""
        entries = list(ended)
        runs = self._store.read(lambda t: t.runs.get_many([entry.run_id for entry in entries], with_metrics=True))
        by_id = {run.id: run for run in runs}
        return [self._as_evaluated(by_id[entry.run_id], entry.protocol) for entry in entries]

    def _as_evaluated(self, run: RunRecord, protocol: Protocol) -> RunRecord:
        if run.protocol is None or run.protocol.fingerprint == protocol.fingerprint:
            return run
        found = self._store.read(lambda t: t.metrics.by_protocol(run.id))
        label = ProtocolLabel(protocol.fingerprint, with_trajectory(protocol.label, run.trajectory))
        return replace(run, protocol=label, metrics={**found.get(None, {}), **found.get(protocol.fingerprint, {})})

    def shown_otherwise(self, ended: Iterable[EvaluationRecord]) -> list[int]:
        """The runs of these evaluations, without failed ones, whose current protocol is another one."""
        fingerprints = {entry.run_id: entry.protocol.fingerprint for entry in ended if entry.reason is None}
        runs = self._store.read(lambda t: t.runs.get_many(fingerprints))
        return [run.id for run in runs if run.protocol is not None and run.protocol.fingerprint != fingerprints[run.id]]
