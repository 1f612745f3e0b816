"""Tests of algorithm packages: which runs show that a package keeps its bounds, and whether they do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from slamhive.documents.catalogue import BoundResult
from slamhive.documents.submission import Submission
from slamhive.domain.algorithm import Algorithm, Bound
from slamhive.domain.run import RunState
from slamhive.domain.verdict import ERROR, RELATION_ERROR, RELATION_ROTATION
from slamhive.store import RunRecord

TIME_LIMIT_S = 3600.0
"""A bound is about the algorithm: a slow machine must not end the run."""


@dataclass(frozen=True, slots=True)
class BoundTest:
    """The test of one bound: one run of the algorithm on the dataset."""

    algorithm: Algorithm
    bound: Bound

    def submission(self, executor: str | None = None) -> Submission:
        """The run to make."""
        bound = self.bound
        return Submission(
            self.algorithm.name,
            bound.dataset,
            bound.parameters,
            executor=executor,
            playback_mode=bound.playback.mode,
            playback_rate=bound.playback.rate,
            alignment=bound.alignment,
            timeout_s=TIME_LIMIT_S,
        )

    def result(self, run: RunRecord) -> BoundResult:
        """Return the bounds that the run, which has ended and been evaluated, shows."""
        metrics = run.metrics or {}
        if run.state is RunState.SUCCEEDED:
            problem = self.bound.broken_by(run.poses, metrics)
        else:
            problem = f"the run is {run.state}: {run.detail or 'no reason is known'}"
        return BoundResult.of(
            self,
            algorithm=self.algorithm.name,
            run=run.id,
            poses=run.poses,
            ate_rmse_m=metrics.get(ERROR),
            relations_m=metrics.get(RELATION_ERROR),
            relations_deg=metrics.get(RELATION_ROTATION),
            latency_median_ms=_scaled(metrics.get("latency.median"), 1e3),
            memory_max_mb=_scaled(metrics.get("ram.max"), 1e-6),
            problem=problem,
        )


def bound_tests(algorithms: Sequence[Algorithm], datasets: Sequence[str] = ()) -> tuple[BoundTest, ...]:
    """The tests of all bounds of ``algorithms``; with ``datasets``, of those on these datasets."""
    return tuple(
        BoundTest(algorithm, bound)
        for algorithm in algorithms
        for bound in algorithm.bounds
        if not datasets or bound.dataset in datasets
    )


def _scaled(value: float | None, factor: float) -> float | None:
    return None if value is None else value * factor
