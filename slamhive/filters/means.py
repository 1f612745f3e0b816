"""Conditions on metrics where runs are grouped: they compare the mean of a configuration, and not single runs.

A condition on single runs would leave only the runs that fulfil it, and the mean of those survivors would flatter every
configuration that ever had one good run.
"""

from __future__ import annotations

from dataclasses import replace

from slamhive.base.errors import InvalidInput
from slamhive.filters.binding import Bound, Condition, Search
from slamhive.filters.fields import OF_CONFIGURATIONS, Source
from slamhive.filters.syntax import Junction, all_of, leaves, mapped


def split_means(search: Search) -> tuple[Bound | None, Bound | None]:
    """The conditions on runs, and those on the means of their configurations; None for none.

    Raises InvalidInput if ``or`` or ``not`` joins a metric with a condition on single runs.
    """
    tree = search.tree
    parts = tree.parts if isinstance(tree, Junction) and tree.word == "and" else () if tree is None else (tree,)
    of_means = [part for part in parts if any(leaf.field.source is Source.METRIC for leaf in leaves(part))]
    for leaf in (leaf for part in of_means for leaf in leaves(part)):
        if leaf.field.source is not Source.METRIC and leaf.field.source not in OF_CONFIGURATIONS:
            raise InvalidInput(
                f"grouped runs compare the mean of a metric, which 'or' and 'not' cannot join with {leaf.field.name}",
                f"join {leaf.field.name} with 'and', or do not group",
            )
    return all_of(part for part in parts if part not in of_means), all_of(mapped(part, _mean) for part in of_means)


def means_of(search: Search) -> Search:
    """The same search, with conditions on metrics as conditions on means, for words and messages."""
    return search if search.tree is None else replace(search, tree=mapped(search.tree, _mean))


def _mean(leaf: Condition) -> Condition:
    if leaf.field.source is not Source.METRIC:
        return leaf
    return replace(leaf, field=replace(leaf.field, label=f"mean {leaf.field.label}", source=Source.MEAN))
