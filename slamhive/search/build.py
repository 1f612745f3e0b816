"""Builds searches in code."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import datetime

from slamhive.domain.run import FailureReason, RunState
from slamhive.search.binding import Condition, Search, Value
from slamhive.search.fields import BUILT_IN
from slamhive.search.grammar import Tree, join
from slamhive.search.syntax import Sign


def matching(  # noqa: PLR0913 - every one may be left out
    *,
    states: Iterable[RunState] = (),
    reasons: Iterable[FailureReason] = (),
    algorithms: Iterable[str] = (),
    datasets: Iterable[str] = (),
    executors: Iterable[str] = (),
    experiments: Iterable[str] = (),
    configuration_id: int | None = None,
    created_after: datetime | None = None,
    created_before: datetime | None = None,
    evaluated: bool | None = None,
) -> Search:
    """Search for runs that match all arguments; empty and None do not restrict.

    ``created_after`` is inclusive, ``created_before`` is not; ``evaluated``: whether an evaluation succeeded.
    """
    parts: list[Tree[Condition]] = []

    def add(name: str, sign: Sign, *values: Value) -> None:
        parts.append(Condition(BUILT_IN[name], sign, values))

    lists: dict[str, Iterable[str]] = {
        "state": states,
        "reason": reasons,
        "algorithm": algorithms,
        "dataset": datasets,
        "executor": executors,
        "experiment": experiments,
    }
    for name, values in lists.items():
        if wanted := tuple(str(value) for value in values):
            add(name, Sign.IN, *wanted)
    if configuration_id is not None:
        add("configuration", Sign.EQUAL, configuration_id)
    if created_after is not None:
        add("created_at", Sign.AT_LEAST, created_after)
    if created_before is not None:
        add("created_at", Sign.LESS, created_before)
    if evaluated is not None:
        add("evaluated", Sign.EQUAL, evaluated)
    return Search(join("and", parts)) if parts else Search()
