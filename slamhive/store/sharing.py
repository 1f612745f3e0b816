"""Owner and visibility of runs, experiments and analyses, and the audience that follows from them."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from sqlalchemy import Table, select, update

from slamhive.domain.accounts import Sharing, Visibility
from slamhive.store.changes import changes_of, maker_of
from slamhive.store.models import AnalysisRow, ExperimentRow, RunRow
from slamhive.store.records import RunRequest
from slamhive.store.rows import Repository, chunks

_RUNS = RunRow.__table__
_EXPERIMENTS = ExperimentRow.__table__
_ANALYSES = AnalysisRow.__table__


def sharing_columns(sharing: Sharing, within: Visibility | None = None) -> dict[str, Any]:
    """The columns of a row."""
    return {"owner": sharing.owner, "visibility": sharing.visibility, "audience": sharing.audience(within)}


class SharingRepository(Repository):
    """A run of an experiment belongs to the owner of the experiment, and is seen by nobody who does not see that."""

    def of_new_runs(self, requests: Sequence[RunRequest]) -> list[RunRequest]:
        """New runs with owner and visibility: of who stores them; of the run that is repeated if a worker does.

        A request that states who may see its run is heeded.
        """
        maker = maker_of(self._connection)
        repeated = self.of_runs({request.retry_of for request in requests if request.retry_of is not None})
        found = []
        for request in requests:
            first = repeated.get(request.retry_of or 0, Sharing())
            alone = maker.visibility if request.experiment_id is None else None
            # The repetition of a run is seen by no more people than the run.
            own = alone and first.visibility and alone.within(first.visibility)
            visibility = request.visibility or own or first.visibility or alone
            found.append(_owned(request, Sharing(maker.owner or first.owner, visibility)))
        return self.of_experiments(found)

    def of_experiments(self, requests: Sequence[RunRequest]) -> list[RunRequest]:
        """The requests, those of experiments with the owner of the experiment."""
        experiments = self._of_experiments(requests)
        return [
            _owned(request, Sharing(experiments[request.experiment_id].owner or request.owner, request.visibility))
            if request.experiment_id in experiments
            else request
            for request in requests
        ]

    def audiences(self, requests: Sequence[RunRequest]) -> dict[str, str]:
        """{uid: audience} of runs to be stored."""
        experiments = self._of_experiments(requests)
        found = {}
        for request in requests:
            experiment = experiments.get(request.experiment_id or 0)
            within = None if experiment is None else experiment.seen_by
            found[request.uid] = Sharing(request.owner, request.visibility).audience(within)
        return found

    def of_runs(self, run_ids: Collection[int]) -> dict[int, Sharing]:
        """{run: owner and own visibility} of those of these runs that are stored."""
        return self._of(_RUNS, run_ids)

    def lock(self, run_ids: Sequence[int]) -> None:
        """Let no other transaction change these runs until this one ends."""
        for part in chunks(sorted(run_ids)):
            # SQLite has locked everything already, and MySQL locks the rows that a write finds, changed or not.
            same = update(_RUNS).where(_RUNS.c.id.in_(part)).values(audience=_RUNS.c.audience)
            self._connection.execute(same)

    def share_runs(self, shared: Mapping[int, Sharing]) -> None:
        """Write owner and visibility of runs."""
        for part in chunks(sorted(shared)):
            query = select(_RUNS.c.id, _RUNS.c.experiment_id).where(_RUNS.c.id.in_(part))
            places = {row.id: row.experiment_id for row in self._connection.execute(query)}
            experiments = self._of(_EXPERIMENTS, set(places.values()))
            for run_id, place in places.items():
                within = None if place is None else experiments[place].seen_by
                self._write(_RUNS, [run_id], shared[run_id], within)

    def share_experiment(self, experiment_id: int, sharing: Sharing) -> None:
        """Write owner and visibility of an experiment; its runs follow."""
        self._write(_EXPERIMENTS, [experiment_id], sharing)
        within, mine = sharing.seen_by, _RUNS.c.experiment_id == experiment_id
        kinds = select(_RUNS.c.owner, _RUNS.c.visibility).where(mine).distinct()
        for owner, own in self._connection.execute(kinds).all():
            alike = [_RUNS.c.owner.is_not_distinct_from(owner), _RUNS.c.visibility.is_not_distinct_from(own)]
            values = sharing_columns(Sharing(sharing.owner or owner, own), within)
            self._connection.execute(update(_RUNS).where(mine, *alike).values(values))
        changes_of(self._connection).experiments.add(experiment_id)

    def share_analysis(self, token: str, sharing: Sharing) -> None:
        """Write owner and visibility of an analysis."""
        self._connection.execute(update(_ANALYSES).where(_ANALYSES.c.token == token).values(sharing_columns(sharing)))

    def in_use(self) -> bool:
        """True if anything belongs to an account."""
        tables = (_RUNS, _EXPERIMENTS, _ANALYSES)
        queries = (select(table.c.id).where(table.c.owner.is_not(None)).limit(1) for table in tables)
        return any(self._connection.execute(query).first() is not None for query in queries)

    def _of_experiments(self, requests: Iterable[RunRequest]) -> dict[int | None, Sharing]:
        return dict(self._of(_EXPERIMENTS, {request.experiment_id for request in requests}).items())

    def _of(self, table: Table, ids: Collection[int | None]) -> dict[int, Sharing]:
        found: dict[int, Sharing] = {}
        for part in chunks(sorted(number for number in ids if number is not None)):
            query = select(table.c.id, table.c.owner, table.c.visibility).where(table.c.id.in_(part))
            found.update((row.id, Sharing(row.owner, row.visibility)) for row in self._connection.execute(query))
        return found

    def _write(self, table: Table, ids: Sequence[int], sharing: Sharing, within: Visibility | None = None) -> None:
        self._connection.execute(update(table).where(table.c.id.in_(ids)).values(sharing_columns(sharing, within)))


def _owned(request: RunRequest, sharing: Sharing) -> RunRequest:
    """The request with owner and visibility; itself if it has them, since a copy costs as much as its row."""
    if (request.owner, request.visibility) == (sharing.owner, sharing.visibility):
        return request
    return replace(request, owner=sharing.owner, visibility=sharing.visibility)
