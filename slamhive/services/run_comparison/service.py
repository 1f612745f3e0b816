"""Comparing a few runs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from slamhive.domain.run import RunState
from slamhive.domain.trajectory_kind import with_trajectory
from slamhive.domain.verdict import judge
from slamhive.errors import NotFound
from slamhive.runs.folder import RunFolder
from slamhive.services.run_comparison.figures import metric_lines
from slamhive.services.run_comparison.marks import unmarked_parts
from slamhive.services.run_comparison.model import CommonProtocol, RunColumn, RunComparison, mixed_trajectories
from slamhive.services.run_comparison.settings import setting_lines, settings_of
from slamhive.store import Store
from slamhive.store.records import EvaluationState, RunRecord
from slamhive.store.transaction import Transaction

_MOST_NAMED = 5
_ByProtocol = Mapping[str | None, Mapping[str, float]]


class RunComparisons:
    """Puts runs side by side.

    Args:
        store: Runs, metrics and evaluations.
        runs_folder: The run folders, for the parameters that were taken from sensors.
    """

    def __init__(self, store: Store, runs_folder: Path) -> None:
        self._store = store
        self._runs_folder = runs_folder

    def of(self, run_ids: Sequence[int], protocol: str | None = None, *, grouped: bool = False) -> RunComparison:
        """Compare runs under one protocol.

        Args:
            run_ids: The runs, as :func:`read_run_ids` returns them.
            protocol: A fingerprint; None for the protocol that the most runs have.
            grouped: Whether the runs of a configuration are one column.

        Raises:
            NotFound: a run is unknown, or no run was evaluated under the protocol.
        """
        runs, values, protocols = self._store.read(lambda t: _read(t, run_ids))
        chosen = _chosen(protocols, runs, protocol)
        fingerprint = None if chosen is None else chosen.fingerprint
        evaluated = {run: found.get(fingerprint, {}) if fingerprint else {} for run, found in values.items()}
        columns = _columns(runs, evaluated, grouped=grouped)
        shown = {run: {**values[run].get(None, {}), **found} for run, found in evaluated.items()}
        unmarked = unmarked_parts(runs, mixed_trajectories=bool(mixed_trajectories(runs, chosen)))
        return RunComparison(
            columns=columns,
            grouped=grouped,
            protocols=protocols,
            protocol=chosen,
            settings=setting_lines([[self._settings_of(run) for run in column.runs] for column in columns]),
            metrics=metric_lines(columns, shown, unmarked),
            unmarked=unmarked,
        )

    def repeats(self, run: RunRecord, most: int) -> tuple[int, ...]:
        """A run and the newest other runs of its configuration, at most ``most``."""
        latest = self._store.read(lambda t: t.configuration_book.latest_runs(run.configuration_id, most))
        others = [other for other in latest if other != run.id]
        return tuple(sorted([run.id, *others[: most - 1]]))

    def _settings_of(self, run: RunRecord) -> dict[str, str]:
        folder = RunFolder(self._runs_folder / str(run.id))
        return settings_of(run, folder.read_record() if folder.record.exists() else {})


def _read(
    t: Transaction, run_ids: Sequence[int]
) -> tuple[tuple[RunRecord, ...], dict[int, _ByProtocol], tuple[CommonProtocol, ...]]:
    unknown = sorted(set(run_ids) - t.run_table.existing(run_ids))
    if unknown:
        shown = ", ".join(map(str, unknown[:_MOST_NAMED])) + (", ..." if len(unknown) > _MOST_NAMED else "")
        raise NotFound(f"unknown run{'s' if len(unknown) > 1 else ''} {shown}", "the page of runs lists all runs")
    runs = t.runs.get_many(run_ids, with_metrics=True)
    values: dict[int, _ByProtocol] = {run.id: t.metrics.by_protocol(run.id) for run in runs}
    labels = {
        entry.protocol.fingerprint: entry.protocol.label
        for run in runs
        for entry in t.evaluations.for_run(run.id)
        if entry.state is EvaluationState.SUCCEEDED
    }
    return runs, values, tuple(_common(key, label, runs, values) for key, label in labels.items())


def _common(key: str, label: str, runs: Sequence[RunRecord], values: Mapping[int, _ByProtocol]) -> CommonProtocol:
    having = tuple(run.id for run in runs if key in values[run.id])
    could = (run.id for run in runs if run.state is RunState.SUCCEEDED)
    kinds = {run.trajectory for run in runs if run.id in having}
    if len(kinds) == 1:
        label = with_trajectory(label, *kinds)
    return CommonProtocol(key, label, having, tuple(run_id for run_id in could if run_id not in having))


def _chosen(protocols: Sequence[CommonProtocol], runs: Sequence[RunRecord], asked: str | None) -> CommonProtocol | None:
    """The protocol that was asked for, or the one that the most runs have; of several, the one that lists show."""
    if asked is not None:
        found = next((entry for entry in protocols if entry.fingerprint == asked), None)
        if found is None:
            known = ", ".join(entry.fingerprint for entry in protocols[:_MOST_NAMED]) or "none"
            raise NotFound(f"no run here was evaluated under protocol {asked[:40]!r}", f"known here: {known}")
        return found
    current = Counter(run.protocol.fingerprint for run in runs if run.protocol is not None)
    return max(protocols, key=lambda entry: (len(entry.runs), current[entry.fingerprint]), default=None)


def _columns(
    runs: Sequence[RunRecord], evaluated: Mapping[int, Mapping[str, float]], *, grouped: bool
) -> tuple[RunColumn, ...]:
    groups: dict[int, list[RunRecord]] = {}
    for run in runs:
        groups.setdefault(run.configuration_id if grouped else run.id, []).append(run)
    return tuple(
        RunColumn(tuple(members), tuple(run.id for run in members if _failed(run, evaluated[run.id])))
        for members in groups.values()
    )


def _failed(run: RunRecord, values: Mapping[str, float]) -> bool:
    """Whether a run counts as failed under the protocol of these values; a run that lacks them is not judged."""
    return run.state is RunState.FAILED or (bool(values) and judge(values).kind.failed)
