"""What the ledger reads from the database and restores: rows with their numbers."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from datetime import datetime
from typing import Any

from sqlalchemy import func, insert, select, union, update

from slamhive.domain import protocol as domain
from slamhive.domain.run import RunState
from slamhive.schema.limits import StopWhen
from slamhive.store.changes import AskedEvaluations, NewRow
from slamhive.store.configuration_models import ConfigurationGroup, ConfigurationLabel
from slamhive.store.configurations import ConfigurationRepository
from slamhive.store.deleted_runs import DeletedRunRepository
from slamhive.store.experiment_records import NewConfiguration
from slamhive.store.filed_runs import AS_FILED, EndedEvaluation
from slamhive.store.models import (
    Configuration,
    Evaluation,
    Experiment,
    ExperimentCell,
    Protocol,
    Run,
    SavedSearch,
)
from slamhive.store.models import RunEvent as EventRow
from slamhive.store.records import EvaluationState, RunRequest
from slamhive.store.rows import Repository, chunks
from slamhive.store.runs import RunRepository

_RUNS = Run.__table__
_CELLS = ExperimentCell.__table__
_EVALUATIONS = Evaluation.__table__
_CONFIGURATIONS = Configuration.__table__
_EVENTS = EventRow.__table__
_ACTIVE = tuple(state for state in RunState if state.active)
_REQUEST = tuple(name for name in RunRequest.__dataclass_fields__ if name not in ("protocol", "stop_when"))

WAITING = (RunState.QUEUED, RunState.CANCELLED)
"""States in which a run may have no folder."""


class LedgerRepository(Repository):
    """Reads and restores what only the ledger holds."""

    # -- out -------------------------------------------------------------------------------------------------------

    def empty(self) -> bool:
        """Whether no configuration, experiment or saved search is stored."""
        tables = (Configuration, Experiment, SavedSearch)
        return not any(self._connection.execute(select(table.id).limit(1)).first() for table in tables)

    def experiments(self) -> dict[int, str]:
        """{number: uid}."""
        return {row.id: row.uid for row in self._connection.execute(select(Experiment.id, Experiment.uid))}

    def sizes(self) -> dict[str, dict[str, Any]]:
        """The counts of cells and runs of each experiment, by its uid."""
        columns = (Experiment.uid, Experiment.cells, Experiment.runs, Experiment.complete)
        return {
            row.uid: {"cells": row.cells, "runs": row.runs, "complete": row.complete}
            for row in self._connection.execute(select(*columns))
        }

    def stored_cells(self) -> dict[str, int]:
        """How many cells of each experiment are stored, by its uid."""
        query = select(Experiment.uid, func.count()).join(_CELLS, _CELLS.c.experiment_id == Experiment.id)
        return {row[0]: row[1] for row in self._connection.execute(query.group_by(Experiment.uid))}

    def configurations(self) -> set[int]:
        """The numbers of all configurations."""
        return set(self._column(select(_CONFIGURATIONS.c.id)))

    def described(self) -> list[int]:
        """The numbers of the configurations that have a name, a note or a group."""
        tables = (ConfigurationLabel.__table__, ConfigurationGroup.__table__)
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
        """How many evaluations have ended, and how many have not."""
        query = select(_EVALUATIONS.c.open, func.count()).group_by(_EVALUATIONS.c.open)
        counts = {row[0]: row[1] for row in self._connection.execute(query)}
        return counts.get(None, 0), counts.get(1, 0)

    def ended(
        self, evaluation_ids: Collection[int] | None = None, after: int = 0
    ) -> list[tuple[int, int, EndedEvaluation]]:
        """Number, run and content of these ended evaluations, or of the next thousand after ``after``."""
        query = (
            select(_EVALUATIONS, Protocol.definition)
            .join(Protocol, Protocol.id == _EVALUATIONS.c.protocol_id)
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
            select(_EVALUATIONS, Protocol.definition)
            .join(Protocol, Protocol.id == _EVALUATIONS.c.protocol_id)
            .where(_EVALUATIONS.c.open == 1)
            .order_by(_EVALUATIONS.c.id)
        )
        together: dict[tuple[Any, ...], list[int]] = defaultdict(list)
        definitions: dict[int, Any] = {}
        for row in self._connection.execute(query):
            definitions[row.protocol_id] = row.definition
            together[row.protocol_id, row.artefacts, row.created_at].append(row.run_id)
        return [
            AskedEvaluations(domain.protocol_from_content(definitions[protocol]), artefacts, at, run_ids)
            for (protocol, artefacts, at), run_ids in together.items()
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
        stop_when=StopWhen.of(row.stop_when),
    )
