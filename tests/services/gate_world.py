"""Runs with chosen values, as gates compare them."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import timedelta
from typing import Any

import numpy as np

from slamhive.domain.protocol import Protocol
from slamhive.domain.run import FailureReason, Host, RunState
from slamhive.evaluation.job import EvaluationResult
from slamhive.services.hive import Hive
from slamhive.store import Lease, Transaction
from tests.web import web_world as world

CHECKSUM = f"sha256:{'1' * 64}"
CPU = "Test CPU"
_ENDS = (RunState.PREPARING, RunState.STARTING, RunState.RUNNING, RunState.COLLECTING)


def errors_m(count: int, median_m: float = 0.05, spread: float = 0.01, seed: int = 0) -> list[float]:
    """Errors of ``count`` repeats."""
    return list(median_m * np.exp(np.random.default_rng(seed).normal(0, spread, count)))


def add_good(
    hive: Hive,
    errors: Sequence[float],
    *,
    cpu: str = CPU,
    checksum: str | None = CHECKSUM,
    protocol: Protocol = world.PROTOCOL,
    **parameters: Any,
) -> list[int]:
    """Runs that succeeded, with these errors, on a machine with this processor."""
    run_ids = world.add_runs(hive, len(errors), **parameters)
    for run_id, error_m in zip(run_ids, errors, strict=True):
        finish(hive, run_id, error_m, cpu=cpu, checksum=checksum, protocol=protocol)
    return run_ids


def finish(
    hive: Hive,
    run_id: int,
    error_m: float,
    *,
    cpu: str = CPU,
    checksum: str | None = CHECKSUM,
    protocol: Protocol = world.PROTOCOL,
) -> None:
    """Let a queued run succeed and be evaluated. Its other values vary with its error by chance."""
    chance = np.random.default_rng(run_id).normal(1.0, 0.01, 3)
    measured = {"cpu.mean": 1.2 * chance[0], "ram.max": 5e8 * chance[1], "latency.p95": 0.03 * chance[2]}

    def start(t: Transaction) -> int:
        t.metrics.put(run_id, None, measured)
        return t.catalogue.put_host(Host(cpu, 2, 8_000_000_000, "6.1", "Linux"))

    host_id = hive.store.write(start)
    world.advance(hive, run_id, *_ENDS, RunState.SUCCEEDED, poses=400, dataset_checksum=checksum, host_id=host_id)
    values = {"ate.rmse": error_m, "ate.per_path": 2 * error_m, "tracked.path": 0.99, "tracked_fraction": 0.98}
    result = EvaluationResult(str(run_id), protocol.fingerprint, None, values, 400, 398, "evo 1.0")

    def evaluate(t: Transaction) -> None:
        (evaluation_id,) = t.evaluations.queue([run_id], protocol, world.NOW)
        t.evaluations.claim(Lease("test", world.NOW, 30.0), runs=[run_id])
        t.evaluations.finish(evaluation_id, "test", result, world.NOW + timedelta(seconds=9))

    hive.store.write(evaluate)


def add_failed(hive: Hive, count: int, **parameters: Any) -> list[int]:
    """Runs that crashed."""
    run_ids = world.add_runs(hive, count, **parameters)
    for run_id in run_ids:
        world.advance(hive, run_id, *_ENDS, RunState.FAILED, reason=FailureReason.NONZERO_EXIT, exit_code=3)
    return run_ids
