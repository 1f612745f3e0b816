"""Disturbed runs in the store: counted in an experiment, replaced by their repetitions, on both kinds of database."""

from __future__ import annotations

from typing import Any

import pytest

from slamhive.domain.run import RunState
from slamhive.domain.trust import Disturbance, DisturbanceKind, DisturbanceReason
from slamhive.store import Store
from tests.store.store_samples import Samples

pytestmark = pytest.mark.quick

QUIET = Disturbance(known=True)
BUSY = Disturbance(
    known=True,
    reasons=(DisturbanceReason(DisturbanceKind.OTHERS, "a"), DisturbanceReason(DisturbanceKind.STEAL, "b")),
    not_measured=("CPU frequency: no file",),
)
UNKNOWN = Disturbance(known=False, not_measured=("the machine was not watched",))


def ended(samples: Samples, found: Disturbance, state: RunState = RunState.SUCCEEDED, **fields: Any) -> int:
    run_id = samples.run_in(state, **fields)
    samples.store.write(lambda tx: tx.runs.update(run_id, disturbance=found))
    return run_id


@pytest.mark.parametrize("found", [QUIET, BUSY, UNKNOWN])
def test_what_is_known_comes_back(store: Store, samples: Samples, found: Disturbance) -> None:
    run_id = ended(samples, found)
    assert store.read(lambda tx: tx.runs.get(run_id)).disturbance == found


@pytest.mark.integration
def test_a_disturbed_run_is_replaced_unless_its_repetition_was_cancelled(
    store: Store, samples: Samples, experiment: int
) -> None:
    mine: dict[str, Any] = {"experiment_id": experiment, "cell": 1}
    quiet = ended(samples, QUIET, **mine)
    unknown = ended(samples, UNKNOWN, **mine)
    alone = ended(samples, BUSY, **mine)
    failed = ended(samples, BUSY, RunState.FAILED, **mine)
    replaced = ended(samples, BUSY, repeat_disturbed=1, **mine)
    again = ended(samples, QUIET, retry_of=replaced, **mine)
    kept = ended(samples, BUSY, **mine)
    cancelled = ended(samples, UNKNOWN, RunState.CANCELLED, retry_of=kept, **mine)
    elsewhere = ended(samples, BUSY)
    after_quiet = ended(samples, QUIET, retry_of=quiet, **mine)

    runs = store.read(lambda tx: tx.experiments.cell_runs(experiment, 1, 1, ["cpu.mean"]))
    assert {run.id for run in runs} == {
        *(quiet, unknown, alone, failed, replaced, again, kept, cancelled, after_quiet)
    }, elsewhere
    assert [run.id for run in runs if run.retried] == [replaced]
    assert {run.id: run.disturbed for run in runs}[unknown] is None
    assert [run.id for run in runs if run.disturbed] == [alone, failed, replaced, kept]
    assert store.read(lambda tx: tx.experiment_counts.disturbed()) == {experiment: 3}
    assert store.read(lambda tx: tx.experiment_counts.disturbed(experiment)) == {experiment: 3}
    assert store.read(lambda tx: tx.experiments.to_repeat(experiment)) == [replaced]
    counts = store.read(lambda tx: tx.experiment_counts.by_experiment(experiment))[experiment]
    assert sum(entry.count for entry in counts if entry.retried) == 1
    assert sum(entry.count for entry in counts) == 9
