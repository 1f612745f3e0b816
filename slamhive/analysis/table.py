"""The table that analyses work on: one row for each run, failed ones included, one column for each fact and metric.

Columns are named as filters name them: ``ate.rmse`` (a metric), ``nFeatures`` (a parameter by its own key or general
name), ``algorithm``. What a run does not have is NaN (numbers) or None (words), never 0.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
import pandas as pd

from slamhive.analysis.colours import algorithm_colours, dataset_markers
from slamhive.domain.metrics import CATALOGUE, Direction
from slamhive.domain.numbers import plural
from slamhive.domain.verdict import (
    DATED_FRACTION,
    ERROR,
    EVIDENCE,
    TRACKED_FRACTION,
    TRACKED_PATH,
    FailureRule,
    VerdictKind,
    judge,
)
from slamhive.errors import InvalidInput, unknown


class ColumnKind(StrEnum):
    """Where a column's values come from."""

    FACT = "fact"
    PARAMETER = "parameter"
    METRIC = "metric"


@dataclass(frozen=True, slots=True)
class Column:
    """What a column means. ``needs_protocol``: its values belong to an evaluation protocol."""

    key: str
    label: str
    kind: ColumnKind
    unit: str = ""
    direction: Direction = Direction.NEUTRAL
    numeric: bool = True
    needs_protocol: bool = False


FACTS = (
    Column("run_id", "Run", ColumnKind.FACT),
    Column("configuration_id", "Configuration", ColumnKind.FACT),
    Column("algorithm", "Algorithm", ColumnKind.FACT, numeric=False),
    Column("dataset", "Dataset", ColumnKind.FACT, numeric=False),
    Column("sensors", "Sensors", ColumnKind.FACT, numeric=False),
    Column("state", "State", ColumnKind.FACT, numeric=False),
    Column("reason", "Reason", ColumnKind.FACT, numeric=False),
    Column("seed", "Seed", ColumnKind.FACT),
    Column("experiment", "Experiment", ColumnKind.FACT, numeric=False),
    Column("variant", "Variant", ColumnKind.FACT, numeric=False),
    Column("executor", "Executor", ColumnKind.FACT, numeric=False),
    Column("host", "Host", ColumnKind.FACT, numeric=False),
    Column("protocol", "Protocol", ColumnKind.FACT, numeric=False),
    Column("protocol_label", "Protocol in words", ColumnKind.FACT, numeric=False),
    Column("evaluation", "Evaluation", ColumnKind.FACT, numeric=False),
    Column("disturbed", "Disturbed by", ColumnKind.FACT, numeric=False),
)
"""The columns that every table has, in this order."""

UNDISTURBED = "nothing"
"""What the column ``disturbed`` says of a run on a quiet machine; None where that is not known."""

FAILED = "failed"
"""The column, added by :func:`mark_failures`, that says why a run counts as failed; None if it counts as good."""


def metric_column(key: str) -> Column:
    """The column of one metric of the catalogue."""
    metric = CATALOGUE[key]
    return Column(
        key, metric.label, ColumnKind.METRIC, metric.unit, metric.direction, needs_protocol=metric.needs_protocol
    )


@dataclass(frozen=True, slots=True)
class RunTable:
    """Runs as rows.

    Attributes:
        frame: Columns as :attr:`columns` names them, one row for each run, by run id.
        columns: What each column means, by key.
        rule: When a run counts as failed.
        colours: The colour of each algorithm.
        markers: The marker of each dataset.
        told: Parameters that say what others say already, by key.
        installed: The sensor set-up of each installed algorithm, with runs or without.
        unevaluated: How many runs are left out because they are not evaluated under the protocol, cancelled or
            unfinished. They are neither good nor failed.
        without_disturbed: How many runs are left out because they were measured on a disturbed machine; None if such
            runs are kept.
    """

    frame: pd.DataFrame
    columns: Mapping[str, Column]
    rule: FailureRule = field(default_factory=FailureRule)
    colours: Mapping[str, str] = field(default_factory=dict)
    markers: Mapping[str, str] = field(default_factory=dict)
    told: frozenset[str] = frozenset()
    installed: Mapping[str, str] = field(default_factory=dict)
    unevaluated: int = 0
    without_disturbed: int | None = None

    def column(self, key: str) -> Column:
        """The column called ``key``; raises NotFound with the nearest name."""
        try:
            return self.columns[key]
        except KeyError:
            known = [*self.columns, *(name for name in CATALOGUE if name not in self.columns)]
            raise unknown("metric or parameter", key, known) from None

    def numeric(self, key: str, purpose: str) -> Column:
        """The column called ``key``, which must hold numbers; raises NotFound or InvalidInput."""
        column = self.column(key)
        if not column.numeric:
            others = [other.key for other in self.varied() if other.numeric]
            numbers = [*others[:6], *(name for name in self.columns if name in CATALOGUE)]
            raise InvalidInput(f"{purpose} needs numbers, {key!r} holds words", f"use for example {', '.join(numbers)}")
        return column

    def failed(self) -> pd.DataFrame:
        """The rows that count as failed."""
        return self.frame[self.frame[FAILED].notna()]

    def good(self) -> pd.DataFrame:
        """The rows that do not."""
        return self.frame[self.frame[FAILED].isna()]

    def disturbed(self) -> pd.DataFrame:
        """The rows of runs that were measured on a disturbed machine."""
        return self.frame[is_disturbed(self.frame)]

    @property
    def disturbance_words(self) -> str:
        """How many runs were measured on a disturbed machine, or are left out because of it; empty if none."""
        if self.without_disturbed:
            return f"{plural(self.without_disturbed, 'run')} measured on a disturbed machine left out."
        count, total = len(self.disturbed()), len(self.frame)
        return f"{count} of {plural(total, 'run')} measured on a disturbed machine." if count else ""

    @property
    def rule_words(self) -> str:
        """The rule as a sentence, and how many runs cannot be judged by all of it."""
        frame = self.frame
        if TRACKED_PATH not in frame or TRACKED_FRACTION not in frame or self.rule.tracked_path_below is None:
            return self.rule.words
        dated = int((frame[TRACKED_PATH].isna() & frame[TRACKED_FRACTION].notna()).sum())
        if not dated:
            return self.rule.words
        return (
            f"{self.rule.words} {dated} of the runs were evaluated before this rule and are judged by the time that "
            f"they tracked ({100 * DATED_FRACTION:g} % are needed); evaluate them again to renew that."
        )

    def with_rows(self, rows: pd.DataFrame) -> RunTable:
        """The same columns over other rows."""
        return replace(self, frame=rows)

    def described(self, units: Mapping[str, str], told: Collection[str]) -> RunTable:
        """The same with units of columns by key, and with columns that others ``told`` already."""
        named = {key: replace(self.columns[key], unit=unit) for key, unit in units.items()}
        return replace(self, columns={**self.columns, **named}, told=frozenset(told))

    def one_protocol(self, keys: Iterable[str]) -> str | None:
        """The protocol in words if any of ``keys`` belongs to one; None if none does.

        Raises:
            InvalidInput: if the runs' values belong to several: they are never averaged, ranked or drawn together.
        """
        needing = [key for key in keys if self.column(key).needs_protocol]
        if not needing:
            return None
        having = self.frame[self.frame[needing].notna().any(axis=1)]
        labels = having.groupby("protocol", sort=True)["protocol_label"].agg(["first", "size"])
        if len(labels) > 1:
            found = "; ".join(f"{row['first']} ({row['size']} runs, {key})" for key, row in labels.iterrows())
            raise InvalidInput(
                f"{needing[0]} was taken under {len(labels)} protocols, which are never mixed: {found}",
                "choose one with 'protocol: FINGERPRINT', or evaluate all runs under one first",
            )
        return str(labels["first"].iloc[0]) if len(labels) else None

    def varied(self) -> list[Column]:
        """The parameters that take more than one value in the runs of an algorithm; of equal columns the first.

        What differs between algorithms alone is part of the algorithm.
        """
        found: dict[tuple[str, ...], Column] = {}
        grouped = self.frame.groupby("algorithm", sort=False)
        for column in self.columns.values():
            asked = column.kind is ColumnKind.PARAMETER and column.key not in self.told
            if asked and (grouped[column.key].nunique(dropna=False) > 1).any():
                found.setdefault(tuple(map(str, self.frame[column.key])), column)
        return list(found.values())


def make_table(
    facts: Mapping[str, Iterable[object]],
    parameters: Mapping[str, Iterable[object]],
    metrics: Mapping[str, Iterable[float | None]],
    rule: FailureRule | None = None,
    installed: Mapping[str, str] | None = None,
) -> RunTable:
    """A table out of columns, each with one entry for each run.

    Args:
        facts: By the keys of :data:`FACTS`; ``run_id``, ``algorithm``, ``dataset`` and ``state`` at least.
        parameters: By key or general name; None where a run does not have it.
        metrics: By catalogue key; None where a run does not have it.
        rule: When a run counts as failed; the default rule if None.
        installed: The sensor set-up of each installed algorithm, with runs or without.
    """
    rows = {key: list(values) for key, values in facts.items()}
    count = len(next(iter(rows.values()), []))
    frame = pd.DataFrame({column.key: rows.get(column.key, [None] * count) for column in FACTS})
    columns = {column.key: column for column in FACTS}
    extra: dict[str, object] = {}
    for key, values in parameters.items():
        entries = list(values)
        numeric = all(entry is None or _is_number(entry) for entry in entries)
        shown = [_as_number(entry) if numeric else None if entry is None else str(entry) for entry in entries]
        extra[key] = np.array(shown, dtype=float) if numeric else np.array(shown, dtype=object)
        columns[key] = Column(key, key, ColumnKind.PARAMETER, numeric=numeric)
    for key, figures in metrics.items():
        extra[key] = np.array([np.nan if figure is None else figure for figure in figures], dtype=float)
        columns[key] = metric_column(key)
    if extra:
        frame = pd.concat([frame, pd.DataFrame(extra, index=frame.index)], axis=1)
    chosen = rule or FailureRule()
    known = installed or {}
    return RunTable(
        frame=mark_failures(frame, chosen),
        columns=columns,
        rule=chosen,
        colours=algorithm_colours(map(str, frame["algorithm"]), known),
        markers=dataset_markers(map(str, frame["dataset"])),
        installed=known,
    )


def is_disturbed(frame: pd.DataFrame) -> pd.Series:
    """Which rows are of runs that are known to have been disturbed."""
    return frame["disturbed"].notna() & (frame["disturbed"] != UNDISTURBED)


def mark_failures(frame: pd.DataFrame, rule: FailureRule) -> pd.DataFrame:
    """``frame`` with the column :data:`FAILED`: why each run counts as failed, None for the good ones."""
    known = [key for key in EVIDENCE if key in frame]
    values = frame[known].to_numpy(dtype=float)
    there = np.isfinite(values)
    why = np.full(len(frame), None, dtype=object)
    facts = frame[["state", "reason", "evaluation"]].itertuples(index=False, name=None)
    for row, (state, reason, evaluation) in enumerate(facts):
        if state != "succeeded":
            why[row] = state if reason is None or pd.isna(reason) else reason
            continue
        metrics = {key: values[row, place] for place, key in enumerate(known) if there[row, place]}
        if ERROR in known and ERROR not in metrics and evaluation != "succeeded":
            why[row] = VerdictKind.NOT_EVALUABLE.label
            continue
        kind = judge(metrics, rule).kind
        why[row] = kind.label if kind.failed else None
    marked = frame.copy()
    marked[FAILED] = pd.Series(why, index=frame.index, dtype=object)
    return marked


def _is_number(entry: object) -> bool:
    return isinstance(entry, int | float | np.number)


def _as_number(entry: object) -> float:
    return float(entry) if isinstance(entry, int | float | np.number) else float("nan")
