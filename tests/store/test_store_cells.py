"""Cells of exported tables: the same values as the records of the runs, but only what the columns ask for."""

from __future__ import annotations

from typing import Any

import pytest

from slamhive.domain.run import RunNotes, RunState
from slamhive.domain.trust import DROPPED_FRAMES
from slamhive.filters.fields import vocabulary_of
from slamhive.services.exports import RunExport, disturbed_text, trust_text
from slamhive.store import RunRecord, RunSort, Store
from tests.store.store_samples import Samples
from tests.store.test_store_disturbance import BUSY
from tests.store.test_store_verdicts import evaluated

pytestmark = pytest.mark.integration

COLUMNS = ("id", "algorithm", "configuration", "playback", "state", "reason", "verdict", "trust", "disturbed", "tags")
METRICS = ("ate.rmse", "tracked.path")


def exported(store: Store, columns: tuple[str, ...], at_once: int = 2) -> list[tuple[Any, ...]]:
    """The rows of an export, read in short pages."""
    content = RunExport(columns, vocabulary_of(store.read(lambda tx: tx.searches.parameters())))

    def page(after: str | None) -> Any:
        return store.read(lambda tx: tx.runs.cells(None, RunSort(), after, at_once, content.wanted))

    return list(content.rows(page))


def of_record(run: RunRecord) -> tuple[Any, ...]:
    metrics = run.metrics or {}
    return (
        run.id,
        run.algorithm,
        run.configuration_id,
        f"{run.playback.mode.value} {run.playback.rate:g}",
        run.state.value,
        run.reason and run.reason.value,
        run.verdict and run.verdict.kind.value,
        trust_text(run.trust),
        disturbed_text(run.disturbance),
        ", ".join(run.tags) or None,
        *(metrics.get(key) for key in METRICS),
    )


def test_exported_values_are_those_of_the_records(store: Store, samples: Samples) -> None:
    runs = evaluated(store, samples, 0.1, 1.4, 0.12, None)
    runs += [samples.run_in(state) for state in (RunState.FAILED, RunState.CANCELLED, RunState.QUEUED)]
    store.write(lambda tx: tx.metrics.put(runs[0], None, {DROPPED_FRAMES: 0.3}))
    store.write(lambda tx: tx.runs.update(runs[1], disturbance=BUSY))
    store.write(lambda tx: tx.notes.put({runs[2]: RunNotes("", ("a", "b"))}))
    records = store.read(lambda tx: tx.runs.get_many(runs, with_metrics=True))
    assert exported(store, (*COLUMNS, *METRICS)) == [of_record(run) for run in sorted(records, key=lambda r: -r.id)]


def test_an_export_reads_nothing_that_no_column_shows(store: Store, samples: Samples) -> None:
    evaluated(store, samples, 0.1)
    content = RunExport(("id", "ate.rmse"), vocabulary_of([]))
    [cells] = store.read(lambda tx: tx.runs.cells(None, RunSort(), None, 10, content.wanted)).records
    assert set(cells.row._fields) == {"id", "configuration_id"}
    assert cells.metrics == {"ate.rmse": 0.1}
    assert cells.parameters.values == {}
