"""What archives read from the database and write to it, in bulk."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from typing import Any

from sqlalchemy import ColumnElement, select, update

from slamhive.domain import protocol as domain
from slamhive.domain.run import RunEvent, RunState
from slamhive.domain.visibility import Sharing
from slamhive.store.changes import changes_of
from slamhive.store.configurations import ConfigurationRepository
from slamhive.store.experiment_records import NewCell, NewConfiguration
from slamhive.store.experiments import ExperimentRepository
from slamhive.store.filed_runs import AS_FILED, EndedEvaluation
from slamhive.store.models import (
    Algorithm,
    Configuration,
    Dataset,
    Evaluation,
    Experiment,
    ExperimentCell,
    Protocol,
    Run,
    SavedSearch,
)
from slamhive.store.models import RunEvent as EventRow
from slamhive.store.records import SavedSearchRecord
from slamhive.store.rows import Repository, chunks, get_or_insert
from slamhive.store.searches import SearchRepository, saved_columns
from slamhive.store.sharing import sharing_columns

_RUNS = Run.__table__
_CELLS = ExperimentCell.__table__
_EVENTS = EventRow.__table__
_EVALUATIONS = Evaluation.__table__
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
        return self._column(select(Configuration.id).order_by(Configuration.id))

    def evaluations(self, run_ids: Collection[int]) -> dict[int, list[EndedEvaluation]]:
        """The evaluations of these runs that have ended, oldest first."""
        query = (
            select(_EVALUATIONS, Protocol.definition)
            .join(Protocol, Protocol.id == _EVALUATIONS.c.protocol_id)
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
        rows = self._connection.execute(select(SavedSearch.name, SavedSearch.created_at))
        from_name = {row.name: row.created_at for row in rows}
        return [(record, from_name[record.name]) for record in SearchRepository(self._connection).saved()]

    # -- in --------------------------------------------------------------------------------------------------------

    def taken(self, run_ids: Sequence[int]) -> set[int]:
        """Those of these numbers that belong to a run."""
        return set(self._column(select(_RUNS.c.id).where(_RUNS.c.id.in_(run_ids))))

    def dataset_if_absent(self, name: str, values: Mapping[str, Any]) -> int:
        """The id of the dataset of this name; stored with ``values`` if there is none."""
        return get_or_insert(self._connection, Dataset, {"name": name}, values)[0]

    def algorithm_if_absent(self, name: str, package: str, mode: str) -> int:
        """The id of the algorithm of this name; stored if there is none."""
        return get_or_insert(self._connection, Algorithm, {"name": name}, {"package": package, "mode": mode})[0]

    def put_configurations(
        self, entries: Sequence[NewConfiguration], created_at: Sequence[datetime]
    ) -> list[tuple[int, bool]]:
        """The number of each configuration, and whether it is new. New ones keep their original time of creation."""
        found = ConfigurationRepository(self._connection).get_or_create_many(entries, max(created_at))
        times = {number: at for (number, new), at in zip(found, created_at, strict=True) if new}
        table = Configuration.__table__
        for number, at in times.items():
            self._connection.execute(update(table).where(table.c.id == number).values(created_at=at))
        changes = changes_of(self._connection)
        changes.configurations = [replace(row, at=times.get(row.id, row.at)) for row in changes.configurations]
        return found

    def experiment(self, uid: str) -> str | None:
        """The name of the experiment with this uid; None if there is none."""
        return self._connection.execute(select(Experiment.name).where(Experiment.uid == uid)).scalar_one_or_none()

    def put_experiment(self, uid: str, name: str, values: Mapping[str, Any]) -> int:
        """The id of the experiment with this uid, stored if there is none; the caller chooses a free ``name``."""
        shared = sharing_columns(Sharing(values.get("owner"), values.get("visibility")))
        return get_or_insert(self._connection, Experiment, {"uid": uid}, {"name": name, **values, **shared})[0]

    def add_cells(self, experiment_id: int, cells: Sequence[NewCell]) -> None:
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
        get_or_insert(self._connection, SavedSearch, {"name": record.name}, values)
        changes_of(self._connection).searches = True

    def _numbers(self, column: ColumnElement[int], *conditions: ColumnElement[bool]) -> set[int]:
        return set(self._column(select(column).where(*conditions)))
