"""Comparisons with the note and the tags of runs, as the rows behind them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from sqlalchemy import ColumnElement, FromClause, Select, literal, select

from slamhive.search.binding import Condition
from slamhive.search.syntax import PRESENCE, Sign
from slamhive.store.models import RunNote, RunTag

OPPOSITE = {Sign.NOT_EQUAL: Sign.EQUAL, Sign.NOT_IN: Sign.IN, Sign.UNLIKE: Sign.LIKE}
"""The comparisons that a run fulfils if it does not fulfil the other one: a run may have several tags."""


def noted(leaf: Condition, compare: Callable[[Any, Condition], ColumnElement[bool]]) -> tuple[FromClause, Select[Any]]:
    """The rows of notes or tags that fulfil a comparison; ``compare`` makes it a condition on a column."""
    rows = (RunTag if leaf.field.name == "tag" else RunNote).__table__.alias()
    query = select(literal(1)).select_from(rows)
    return rows, query if leaf.sign in PRESENCE else query.where(compare(rows.c[leaf.field.name], leaf))
