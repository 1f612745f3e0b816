"""Rows with their numbers, which the ledger and archives read from the database and restore."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from typing import Any

from sqlalchemy import ColumnElement, func, insert, select, union, update

from slamhive.domain import protocol as domain
from slamhive.domain.accounts import Sharing
from slamhive.domain.run import RunEvent, RunState
from slamhive.store.changes import AskedEvaluations, NewRow, changes_of
from slamhive.store.configuration_listing import ConfigurationGroupRow, ConfigurationLabelRow
from slamhive.store.configurations import ConfigurationRepository
from slamhive.store.experiments import ExperimentRepository
from slamhive.store.filed_runs import AS_FILED
from slamhive.store.models import (
    AlgorithmRow,
    ConfigurationRow,
    DatasetRow,
    EvaluationRow,
    ExperimentCellRow,
    ExperimentRow,
    ProtocolRow,
    RunEventRow,
    RunRow,
    SavedSearchRow,
)
from slamhive.store.records import (
    CellRecord,
    EndedEvaluation,
    EvaluationState,
    NewConfiguration,
    RunRequest,
    SavedSearchRecord,
)
from slamhive.store.rows import Repository, chunks, get_or_insert
from slamhive.store.run_listing import options_of_row
from slamhive.store.runs import DeletedRunRepository, RunRepository
from slamhive.store.searches import SearchRepository, saved_columns
from slamhive.store.sharing import sharing_columns

_RUNS = RunRow.__table__
_CELLS = ExperimentCellRow.__table__
_EVALUATIONS = EvaluationRow.__table__
_CONFIGURATIONS = ConfigurationRow.__table__
_EVENTS = RunEventRow.__table__
_ACTIVE = tuple(state for state in RunState if state.active)
_REQUEST = tuple(name for name in RunRequest.__dataclass_fields__ if name in _RUNS.c and name != "stop_when")

WAITING = (RunState.QUEUED, RunState.CANCELLED)
"""States in which a run may have no folder."""


class LedgerRepository(Repository):
    """Reads and restores what only the ledger holds."""

    # -- out -------------------------------------------------------------------------------------------------------

    def empty(self) -> bool:
        """True if no configuration, experiment or saved search is stored."""
        tables = (ConfigurationRow, ExperimentRow, SavedSearchRow)
        return not any(self._connection.execute(select(table.id).limit(1)).first() for table in tables)

    def experiments(self) -> dict[int, str]:
        """{number: uid}."""
        return {row.id: row.uid for row in self._connection.execute(select(ExperimentRow.id, ExperimentRow.uid))}

    def sizes(self) -> dict[str, dict[str, Any]]:
        """The counts of cells and runs of each experiment, by its uid."""
        columns = (ExperimentRow.uid, ExperimentRow.cells, ExperimentRow.runs, ExperimentRow.complete)
        return {
            row.uid: {"cells": row.cells, "runs": row.runs, "complete": row.complete}
            for row in self._connection.execute(select(*columns))
        }

    def stored_cells(self) -> dict[str, int]:
        """The number of stored cells of each experiment, by its uid."""
        query = select(ExperimentRow.uid, func.count()).join(_CELLS, _CELLS.c.experiment_id == ExperimentRow.id)
        return {row[0]: row[1] for row in self._connection.execute(query.group_by(ExperimentRow.uid))}

    def configurations(self) -> set[int]:
        """The numbers of all configurations."""
        return set(self._column(select(_CONFIGURATIONS.c.id)))

    def described(self) -> list[int]:
        """The numbers of the configurations that have a name, a note or a group."""
        tables = (ConfigurationLabelRow.__table__, ConfigurationGroupRow.__table__)
        query = union(*(select(table.c.configuration_id) for table in tables))
        return sorted(self._connection.execute(query).scalars())

    def waiting(self) -> dict[int, RunState]:
        """Runs that may have no folder, and their states."""
        query = select(_RUNS.c.id, _RUNS.c.state).where(_RUNS.c.state.in_(WAITING))
        return {row.id: row.state for row in self._connection.execute(query)}

    def asked_to_end(self) -> list[int]:
        """Active runs that a user has cancelled."""
        query = select(_RUNS.c.id).where(_RUNS.c.state.in_(_ACTIVE), _RUNS.c.cancel_requested)
        return self._column(query.order_by(_RUNS.c.id))

    def requests(self, run_ids: Sequence[int]) -> list[NewRow[RunRequest]]:
        """The requests of these runs."""
        query = select(_RUNS).where(_RUNS.c.id.in_(run_ids)).order_by(_RUNS.c.id)
        return [NewRow(row.id, _request(row), row.created_at) for row in self._connection.execute(query)]

    def cancellations(self, run_ids: Collection[int]) -> dict[int, tuple[datetime, str]]:
        """{number: when and why} of those of these runs that were cancelled."""
        query = select(_EVENTS).where(_EVENTS.c.run_id.in_(run_ids), _EVENTS.c.to_state == RunState.CANCELLED)
        return {row.run_id: (row.at, row.why) for row in self._connection.execute(query)}

    def evaluation_counts(self) -> tuple[int, int]:
        """The numbers of evaluations that have ended and that have not."""
        query = select(_EVALUATIONS.c.open, func.count()).group_by(_EVALUATIONS.c.open)
        counts = {row[0]: row[1] for row in self._connection.execute(query)}
        return counts.get(None, 0), counts.get(1, 0)

    def ended(
        self, evaluation_ids: Collection[int] | None = None, after: int = 0
    ) -> list[tuple[int, int, EndedEvaluation]]:
        """Number, run and content of these ended evaluations, or of the next thousand after ``after``."""
        query = (
            select(_EVALUATIONS, ProtocolRow.definition)
            .join(ProtocolRow, ProtocolRow.id == _EVALUATIONS.c.protocol_id)
            .where(_EVALUATIONS.c.open.is_(None), _EVALUATIONS.c.id > after)
            .order_by(_EVALUATIONS.c.id)
        )
        query = query.limit(1000) if evaluation_ids is None else query.where(_EVALUATIONS.c.id.in_(evaluation_ids))
        found = []
        for row in self._connection.execute(query):
            values = {name: getattr(row, name) for name in AS_FILED}
            entry = EndedEvaluation(domain.protocol_from_content(row.definition), **values)
            found.append((row.id, row.run_id, entry))
        return found

    def open(self) -> list[AskedEvaluations]:
        """Evaluations that have not ended, grouped as they were requested."""
        query = (
            select(_EVALUATIONS, ProtocolRow.definition)
            .join(ProtocolRow, ProtocolRow.id == _EVALUATIONS.c.protocol_id)
            .where(_EVALUATIONS.c.open == 1)
            .order_by(_EVALUATIONS.c.id)
        )
        together: dict[tuple[Any, ...], list[int]] = defaultdict(list)
        definitions: dict[int, Any] = {}
        for row in self._connection.execute(query):
            definitions[row.protocol_id] = row.definition
            together[row.protocol_id, row.artefacts, row.created_at, row.makes_current].append(row.run_id)
        return [
            AskedEvaluations(domain.protocol_from_content(definitions[protocol]), artefacts, at, run_ids, makes_current)
            for (protocol, artefacts, at, makes_current), run_ids in together.items()
        ]

    # -- in --------------------------------------------------------------------------------------------------------

    def restore_configurations(
        self, entries: Mapping[int, NewConfiguration], created_at: Mapping[int, datetime]
    ) -> dict[int, int]:
        """Store configurations under their numbers where these are free; {old number: number here}."""
        taken = set(self._column(select(_CONFIGURATIONS.c.id).where(_CONFIGURATIONS.c.id.in_(entries))))
        repository = ConfigurationRepository(self._connection)
        free = {number: entry for number, entry in entries.items() if number not in taken}
        found = repository.restore(free, created_at)
        rest = [number for number in entries if number in taken]
        others = repository.get_or_create_many([entries[number] for number in rest], max(created_at.values()))
        return {**found, **{number: other for number, (other, _) in zip(rest, others, strict=True)}}

    def unknown(self, run_ids: Sequence[int], uids: Sequence[str]) -> set[int]:
        """Those of some hundreds of numbers that are free and whose uid is neither stored nor deleted."""
        query = select(_RUNS.c.id, _RUNS.c.uid).where(_RUNS.c.id.in_(run_ids) | _RUNS.c.uid.in_(uids))
        rows = self._connection.execute(query).all()
        numbers, known = {row.id for row in rows}, {row.uid for row in rows}
        known |= DeletedRunRepository(self._connection).among(uids)
        return {number for number, uid in zip(run_ids, uids, strict=True) if number not in numbers and uid not in known}

    def repeat(self, originals: Mapping[int, int]) -> None:
        """Note which run each of these repeats, if that run is stored."""
        for part in chunks(sorted(originals)):
            wanted = {originals[run_id] for run_id in part}
            here = set(self._column(select(_RUNS.c.id).where(_RUNS.c.id.in_(wanted))))
            for run_id in part:
                if originals[run_id] in here:
                    self._connection.execute(
                        update(_RUNS).where(_RUNS.c.id == run_id).values(retry_of=originals[run_id])
                    )

    def cancel_if_queued(self, run_id: int, at: datetime, why: str) -> None:
        """Cancel a run if it is still queued."""
        state = self._connection.execute(select(_RUNS.c.state).where(_RUNS.c.id == run_id)).scalar_one()
        if state is RunState.QUEUED:
            RunRepository(self._connection).move(run_id, RunState.CANCELLED, why=why, now=at)

    def ask_to_end(self, run_ids: Sequence[int]) -> None:
        """Ask the workers of those of these runs that are active to end them."""
        for part in chunks(run_ids):
            active = [_RUNS.c.id.in_(part), _RUNS.c.state.in_(_ACTIVE)]
            self._connection.execute(update(_RUNS).where(*active).values(cancel_requested=True))

    def queue_evaluations(self, asked: AskedEvaluations, protocol_id: int) -> int:
        """Queue the evaluations of runs that succeeded, unless they are queued already; how many."""
        runs: list[int] = []
        for part in chunks(asked.run_ids):
            waits = select(_EVALUATIONS.c.run_id).where(
                _EVALUATIONS.c.run_id.in_(part), _EVALUATIONS.c.protocol_id == protocol_id, _EVALUATIONS.c.open == 1
            )
            query = select(_RUNS.c.id).where(
                _RUNS.c.id.in_(part), _RUNS.c.state == RunState.SUCCEEDED, _RUNS.c.id.not_in(waits)
            )
            runs += self._column(query.order_by(_RUNS.c.id))
        values = {
            "protocol_id": protocol_id,
            "open": 1,
            "state": EvaluationState.QUEUED,
            "created_at": asked.at,
            "attempt": 0,
            "makes_current": asked.makes_current,
        }
        if runs:
            rows = [{"run_id": run_id, "artefacts": asked.artefacts, **values} for run_id in runs]
            self._connection.execute(insert(_EVALUATIONS), rows)
        return len(runs)


def _request(row: Any) -> RunRequest:
    override = row.protocol_override
    return RunRequest(
        **{name: getattr(row, name) for name in _REQUEST},
        protocol=None if override is None else domain.protocol_from_content(override),
        **options_of_row(row),
    )


# -- archives: the same in bulk, by the identity that rows have in every installation ----------------------------------

_ENDED = tuple(state for state in RunState if state.ended)


class ArchiveRepository(Repository):
    """Rows by the identity that they have in every installation: the uid of a run, the name or content of the rest."""

    # -- out -------------------------------------------------------------------------------------------------------

    def ended(self) -> list[int]:
        """The numbers of all runs that have ended, in order."""
        query = select(_RUNS.c.id).where(_RUNS.c.state.in_(_ENDED)).order_by(_RUNS.c.id)
        return self._column(query)

    def ended_among(self, run_ids: Sequence[int]) -> list[int]:
        """The numbers of those of these runs that have ended, in order."""
        found: list[int] = []
        for part in chunks(sorted(set(run_ids))):
            query = select(_RUNS.c.id).where(_RUNS.c.id.in_(part), _RUNS.c.state.in_(_ENDED))
            found += self._column(query.order_by(_RUNS.c.id))
        return found

    def uids(self, run_ids: Iterable[int]) -> dict[int, str]:
        """{number: uid} of runs."""
        found: dict[int, str] = {}
        for part in chunks(sorted(set(run_ids))):
            for row in self._connection.execute(select(_RUNS.c.id, _RUNS.c.uid).where(_RUNS.c.id.in_(part))):
                found[row.id] = row.uid
        return found

    def configurations_of(self, run_ids: Iterable[int], experiment_ids: Collection[int]) -> list[int]:
        """The numbers of the configurations of these runs and of the cells of these experiments, in order."""
        found: set[int] = set()
        for part in chunks(sorted(set(run_ids))):
            found.update(self._column(select(_RUNS.c.configuration_id).where(_RUNS.c.id.in_(part)).distinct()))
        cells = select(_CELLS.c.configuration_id).where(_CELLS.c.experiment_id.in_(experiment_ids)).distinct()
        return sorted(found | set(self._column(cells)))

    def all_configurations(self) -> list[int]:
        """The numbers of all configurations, in order."""
        return self._column(select(ConfigurationRow.id).order_by(ConfigurationRow.id))

    def evaluations(self, run_ids: Collection[int]) -> dict[int, list[EndedEvaluation]]:
        """The evaluations of these runs that have ended, oldest first."""
        query = (
            select(_EVALUATIONS, ProtocolRow.definition)
            .join(ProtocolRow, ProtocolRow.id == _EVALUATIONS.c.protocol_id)
            .where(_EVALUATIONS.c.run_id.in_(run_ids), _EVALUATIONS.c.ended_at.is_not(None))
            .order_by(_EVALUATIONS.c.id)
        )
        found: dict[int, list[EndedEvaluation]] = defaultdict(list)
        for row in self._connection.execute(query):
            values = {name: getattr(row, name) for name in AS_FILED}
            found[row.run_id].append(EndedEvaluation(domain.protocol_from_content(row.definition), **values))
        return found

    def events(self, run_ids: Collection[int]) -> dict[int, list[RunEvent]]:
        """The moves of these runs, oldest first."""
        query = select(_EVENTS).where(_EVENTS.c.run_id.in_(run_ids)).order_by(_EVENTS.c.id)
        found: dict[int, list[RunEvent]] = defaultdict(list)
        for row in self._connection.execute(query):
            found[row.run_id].append(RunEvent(row.at, row.from_state, row.to_state, row.why))
        return found

    def saved_searches(self) -> list[tuple[SavedSearchRecord, datetime]]:
        """All saved searches, and when each of them was saved."""
        rows = self._connection.execute(select(SavedSearchRow.name, SavedSearchRow.created_at))
        from_name = {row.name: row.created_at for row in rows}
        return [(record, from_name[record.name]) for record in SearchRepository(self._connection).saved()]

    # -- in --------------------------------------------------------------------------------------------------------

    def taken(self, run_ids: Sequence[int]) -> set[int]:
        """Those of these numbers that belong to a run."""
        return set(self._column(select(_RUNS.c.id).where(_RUNS.c.id.in_(run_ids))))

    def dataset_if_absent(self, name: str, values: Mapping[str, Any]) -> int:
        """The id of the dataset of this name; stored with ``values`` if there is none."""
        return get_or_insert(self._connection, DatasetRow, {"name": name}, values)[0]

    def algorithm_if_absent(self, name: str, package: str, mode: str) -> int:
        """The id of the algorithm of this name; stored if there is none."""
        return get_or_insert(self._connection, AlgorithmRow, {"name": name}, {"package": package, "mode": mode})[0]

    def put_configurations(
        self, entries: Sequence[NewConfiguration], created_at: Sequence[datetime]
    ) -> list[tuple[int, bool]]:
        """The number of each configuration, and whether it is new. New ones keep their original time of creation."""
        found = ConfigurationRepository(self._connection).get_or_create_many(entries, max(created_at))
        times = {number: at for (number, new), at in zip(found, created_at, strict=True) if new}
        table = ConfigurationRow.__table__
        for number, at in times.items():
            self._connection.execute(update(table).where(table.c.id == number).values(created_at=at))
        changes = changes_of(self._connection)
        changes.configurations = [replace(row, at=times.get(row.id, row.at)) for row in changes.configurations]
        return found

    def experiment(self, uid: str) -> str | None:
        """The name of the experiment with this uid; None if there is none."""
        return self._connection.execute(select(ExperimentRow.name).where(ExperimentRow.uid == uid)).scalar_one_or_none()

    def put_experiment(self, uid: str, name: str, values: Mapping[str, Any]) -> int:
        """The id of the experiment with this uid, stored if there is none; the caller chooses a free ``name``."""
        shared = sharing_columns(Sharing(values.get("owner"), values.get("visibility")))
        return get_or_insert(self._connection, ExperimentRow, {"uid": uid}, {"name": name, **values, **shared})[0]

    def add_cells(self, experiment_id: int, cells: Sequence[CellRecord]) -> None:
        """Store the cells that are not stored yet."""
        if cells:
            wanted = [cell.number for cell in cells]
            numbers = _CELLS.c.number.between(min(wanted), max(wanted))
            here = self._numbers(_CELLS.c.number, _CELLS.c.experiment_id == experiment_id, numbers)
            missing = [cell for cell in cells if cell.number not in here]
            ExperimentRepository(self._connection).add_cells(experiment_id, missing)

    def saved_search_if_absent(self, record: SavedSearchRecord, created_at: datetime) -> None:
        """Save a search unless its name is taken."""
        values = saved_columns(record) | {"created_at": created_at}
        get_or_insert(self._connection, SavedSearchRow, {"name": record.name}, values)
        changes_of(self._connection).searches = True

    def _numbers(self, column: ColumnElement[int], *conditions: ColumnElement[bool]) -> set[int]:
        return set(self._column(select(column).where(*conditions)))
