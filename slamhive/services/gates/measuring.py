"""The values of runs under one protocol, as baselines hold them and checks compare them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from slamhive.domain.metrics import METRICS, Direction
from slamhive.domain.run import RunState
from slamhive.domain.verdict import FROM_REPEATS, VerdictKind
from slamhive.schema.gate import LARGEST_VALUE, MeasuredRun
from slamhive.store import RunRecord, Transaction
from slamhive.store.metrics import VERDICT
from slamhive.store.verdicts import kind_of


def measured_runs(t: Transaction, runs: Sequence[RunRecord], fingerprint: str) -> dict[int, MeasuredRun]:
    """{run: its values} of runs that have ended; one that was not evaluated under the protocol is left out.

    A failed run needs no evaluation: it has failed under every protocol.
    """
    known = fingerprint in t.searches.protocols()
    protocol_id = t.run_table.protocol_id(fingerprint) if known else None
    run_ids = [run.id for run in runs]
    values = t.metrics.for_runs(run_ids, protocol_id=protocol_id, verdicts=True) if known else {}
    found: dict[int, MeasuredRun] = {}
    for run in runs:
        own = values.get(run.id, {})
        failed = _failed(run, own)
        if failed is not None or VERDICT in own:
            found[run.id] = _measured(run, own, failed)
    return found


def _failed(run: RunRecord, values: Mapping[str, float]) -> VerdictKind | None:
    """Why a run counts as failed; None for one that is good or was not evaluated."""
    kind = VerdictKind.ENDED_BADLY if run.state is RunState.FAILED else kind_of(values.get(VERDICT))
    return kind if kind is not None and kind.failed else None


def _measured(run: RunRecord, values: Mapping[str, float], failed: VerdictKind | None) -> MeasuredRun:
    return MeasuredRun.of(
        run,
        version=run.version_label,
        cpu_model=None if run.host is None else run.host.cpu_model,
        disturbed=None if run.disturbance is None else run.disturbance.disturbed,
        failed=failed,
        metrics={key: value for key, value in values.items() if _can_become_worse(key) and abs(value) <= LARGEST_VALUE},
    )


def _can_become_worse(key: str) -> bool:
    metric = METRICS.entries.get(key)
    if metric is None or key in FROM_REPEATS:
        return False
    return metric.direction is not Direction.NEUTRAL
