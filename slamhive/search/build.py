"""Searches made in code rather than typed."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import datetime

from slamhive.search.binding import Condition, Search, Value
from slamhive.search.fields import BUILT_IN
from slamhive.search.grammar import Tree, join
from slamhive.search.syntax import Sign


def matching(
    *,
    ids: Iterable[int] | None = None,
    configuration: int | None = None,
    experiment: str | None = None,
    evaluated: bool | None = None,
    created_before: datetime | None = None,
    **one_of: Iterable[str],
) -> Search:
    """The runs that fit all that is given.

    Args:
        ids: Numbers of runs.
        configuration: Number of the configuration.
        experiment: Name of the experiment.
        evaluated: Whether an evaluation succeeded.
        created_before: Exclusive.
        one_of: A built-in name (``state``, ``algorithm`` ...) and the values it may have; none does not restrict.
    """
    parts: list[Tree[Condition]] = []

    def add(name: str, sign: Sign, *values: Value) -> None:
        parts.append(Condition(BUILT_IN[name], sign, values))

    for name, values in one_of.items():
        if wanted := tuple(str(value) for value in values):
            add(name, Sign.IN, *wanted)
    if ids is not None:
        add("id", Sign.IN, *(float(run_id) for run_id in ids))
    if configuration is not None:
        add("configuration", Sign.EQUAL, float(configuration))
    if experiment is not None:
        add("experiment", Sign.EQUAL, experiment)
    if evaluated is not None:
        add("evaluated", Sign.EQUAL, evaluated)
    if created_before is not None:
        add("created_at", Sign.LESS, created_before)
    return Search(join("and", parts)) if parts else Search()
