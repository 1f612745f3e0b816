"""The table of runs: one row for each run, including failed ones, one column for each fact, parameter and metric.

Columns have the names that filters use: ``ate.rmse`` (a metric), ``nFeatures`` (a parameter by its key or general
name), ``algorithm``. A missing value is NaN (numbers) or None (text), never 0.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
import pandas as pd

from slamhive.analysis.chart import MARKERS, algorithm_colours, dataset_markers, marker_of
from slamhive.base.errors import InvalidInput, unknown
from slamhive.domain.dataset import ATTRIBUTE_KINDS
from slamhive.domain.metrics import CATALOGUE, Direction
from slamhive.domain.names import plural
from slamhive.domain.protocol import Protocol, TrajectoryKind, with_trajectory
from slamhive.domain.side_by_side import MixedProtocols, ProtocolUse, mixed_protocols
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


class ColumnKind(StrEnum):
    """The source of a column."""

    FACT = "fact"
    PARAMETER = "parameter"
    METRIC = "metric"


@dataclass(frozen=True, slots=True)
class Column:
    """One column. ``needs_protocol``: its values depend on an evaluation protocol."""

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
    Column("version", "Version", ColumnKind.FACT, numeric=False),
    Column("protocol", "Protocol", ColumnKind.FACT, numeric=False),
    Column("protocol_label", "Protocol in words", ColumnKind.FACT, numeric=False),
    Column("evaluation", "Evaluation", ColumnKind.FACT, numeric=False),
    Column("disturbed", "Disturbed by", ColumnKind.FACT, numeric=False),
    Column("trajectory", "Trajectory", ColumnKind.FACT, numeric=False),
    Column("cpu_cores", "CPU limit", ColumnKind.PARAMETER, "cores"),
    Column("memory_mb", "Memory limit", ColumnKind.PARAMETER, "MB"),
    Column("slow_down", "Slowed down", ColumnKind.PARAMETER, "times"),
    Column("image_width", "Image width", ColumnKind.FACT, "px"),
    Column("image_height", "Image height", ColumnKind.FACT, "px"),
    Column("image_rate_hz", "Image rate", ColumnKind.FACT, "Hz"),
    Column("imu_rate_hz", "IMU rate", ColumnKind.FACT, "Hz"),
)
"""The columns of every table, in this order."""

LIMITS = ("cpu_cores", "memory_mb", "slow_down")
"""The columns of limits, which runs of one configuration need not share."""

UNDER_LIMITS = "under_limits"
"""The column of :meth:`RunTable.with_limits`."""

NOT_STATED = "not stated"
"""The group of runs without a value."""

UNDISTURBED = "nothing"
"""The value of the column ``disturbed`` for a run on a quiet machine; None if unknown."""

FAILED = "failed"
"""The column with the reason why a run counts as failed, None for good runs; :func:`mark_failures` adds it."""


def metric_column(key: str) -> Column:
    """The column of a metric of the catalogue."""
    metric = CATALOGUE[key]
    return Column(
        key, metric.label, ColumnKind.METRIC, metric.unit, metric.direction, needs_protocol=metric.needs_protocol
    )


@dataclass(frozen=True, slots=True)
class RunTable:
    """Runs as rows.

    Attributes:
        frame: One row for each run, sorted by run id.
        columns: The columns by key.
        rule: When a run counts as failed.
        colours: The colour of each algorithm.
        markers: The marker of each dataset.
        repeated: Keys of parameters that repeat other parameters.
        installed: The sensor set-up of each installed algorithm, including those without runs.
        not_evaluated: Number of runs left out because they were not evaluated under the protocol, were cancelled, or
            have not ended: they are neither good nor failed.
        without_disturbed: Number of runs left out because the machine was disturbed; None if such runs are kept.
        definitions: The protocols of the runs by fingerprint, as far as they are known.
    """

    frame: pd.DataFrame
    columns: Mapping[str, Column]
    rule: FailureRule = field(default_factory=FailureRule)
    colours: Mapping[str, str] = field(default_factory=dict)
    markers: Mapping[str, str] = field(default_factory=dict)
    repeated: frozenset[str] = frozenset()
    installed: Mapping[str, str] = field(default_factory=dict)
    not_evaluated: int = 0
    without_disturbed: int | None = None
    definitions: Mapping[str, Protocol] = field(default_factory=dict)

    def marker(self, algorithm: str, dataset: str | None = None) -> str:
        """The marker of the runs of an algorithm: that of their dataset, or of the algorithm if there is one dataset.

        Without ``dataset``, the one for the legend.
        """
        if len(self.markers) <= 1:
            return marker_of(algorithm, self.colours)
        return MARKERS[0] if dataset is None else self.markers[dataset]

    def require_runs(self) -> RunTable:
        """This table; raises InvalidInput if it is empty."""
        if self.frame.empty:
            raise InvalidInput("the selection contains no run", "widen it; the page of runs lists all runs")
        return self

    def column(self, key: str) -> Column:
        """The column ``key``; raises NotFound with the nearest name."""
        try:
            return self.columns[key]
        except KeyError:
            known = [*self.columns, *(name for name in CATALOGUE if name not in self.columns)]
            raise unknown("metric or parameter", key, known) from None

    def grouped_by(self, key: str) -> RunTable:
        """The table with a text in every row of the column ``key``; raises NotFound, or InvalidInput for a metric.

        Groups are in alphabetical order, those of a number in its order.
        """
        column = self.column(key)
        if column.kind is ColumnKind.METRIC:
            raise InvalidInput(f"runs cannot be grouped by the metric {key}", "use a parameter or an attribute")
        values = self.frame[key].sort_values() if column.numeric else self.frame[key]
        texts = values.map(lambda value: NOT_STATED if pd.isna(value) else _text(value)).astype(object)
        groups = texts.unique() if column.numeric else sorted(texts.unique())
        return self.with_rows(self.frame.assign(**{key: texts.astype(pd.CategoricalDtype(groups, ordered=True))}))

    def groups(self, key: str) -> tuple[str, ...]:
        """The groups of a table that is grouped by ``key``, in their order."""
        return tuple(self.frame[key].cat.categories)

    def numeric(self, key: str, purpose: str) -> Column:
        """The column ``key``, which must be numeric; raises NotFound or InvalidInput."""
        column = self.column(key)
        if not column.numeric:
            others = [other.key for other in self.varied() if other.numeric]
            numbers = [*others[:6], *(name for name in self.columns if name in CATALOGUE)]
            raise InvalidInput(f"{purpose} needs numbers, {key!r} is text", f"use for example {', '.join(numbers)}")
        return column

    def failed(self) -> pd.DataFrame:
        """The failed runs."""
        return self.frame[self.frame[FAILED].notna()]

    def good(self) -> pd.DataFrame:
        """The runs that did not fail."""
        return self.frame[self.frame[FAILED].isna()]

    def disturbed(self) -> pd.DataFrame:
        """The runs that were measured on a disturbed machine."""
        return self.frame[is_disturbed(self.frame)]

    @property
    def disturbance_words(self) -> str:
        """A sentence on runs that were measured on a disturbed machine; empty if there are none."""
        if self.without_disturbed:
            return f"{plural(self.without_disturbed, 'run')} measured on a disturbed machine left out."
        count, total = len(self.disturbed()), len(self.frame)
        return f"{count} of {plural(total, 'run')} measured on a disturbed machine." if count else ""

    @property
    def mixed_versions(self) -> dict[str, tuple[str, ...]]:
        """The versions of each algorithm whose runs used several."""
        known = self.frame.dropna(subset=["version"]).groupby("algorithm", sort=True)["version"]
        used = {str(name): tuple(sorted(set(map(str, labels)))) for name, labels in known}
        return {name: labels for name, labels in used.items() if len(labels) > 1}

    @property
    def version_words(self) -> str:
        """A sentence on algorithms whose runs used several versions; empty if there are none."""
        mixed = [f"{name} ({', '.join(labels)})" for name, labels in self.mixed_versions.items()]
        return f"Several versions together: {', '.join(mixed)}." if mixed else ""

    @property
    def mixed_trajectories(self) -> dict[str, tuple[str, ...]]:
        """The algorithms by the kind of the trajectory that was judged, if there are several kinds.

        Protocols that name a kind judge the same of all runs.
        """
        if not {"trajectory", "protocol_label"} <= set(self.frame):
            return {}
        judged = self.frame.dropna(subset=["trajectory", "protocol_label"])
        kinds: dict[str, set[str]] = {}
        for name, kind, label in zip(judged["algorithm"], judged["trajectory"], judged["protocol_label"], strict=True):
            if with_trajectory(label, TrajectoryKind(kind)) != label:
                kinds.setdefault(str(kind), set()).add(str(name))
        return {kind: tuple(sorted(names)) for kind, names in sorted(kinds.items())} if len(kinds) > 1 else {}

    @property
    def trajectory_words(self) -> str:
        """A sentence on runs of which different kinds of trajectories were judged; empty if there is one kind."""
        mixed = [f"{kind} of {', '.join(names)}" for kind, names in self.mixed_trajectories.items()]
        return f"Several kinds of trajectories together: {'; '.join(mixed)}." if mixed else ""

    @property
    def mixed_cpus(self) -> dict[str, int]:
        """The number of runs on each CPU model, the most used first; empty if all known ones are the same."""
        runs = Counter(map(str, self.frame["host"].dropna()))
        return dict(sorted(runs.items(), key=lambda entry: (-entry[1], entry[0]))) if len(runs) > 1 else {}

    @property
    def cpu_words(self) -> str:
        """A sentence on runs that were measured on several CPU models; empty if they were not."""
        mixed = [f"{model} ({plural(runs, 'run')})" for model, runs in self.mixed_cpus.items()]
        return f"Several CPU models together: {', '.join(mixed)}." if mixed else ""

    @property
    def limit_words(self) -> str:
        """A sentence on runs of one algorithm under several limits; empty if the limits are the same."""
        mixed = []
        for key in self.varied_limits:
            values = sorted(self.frame[key].unique(), key=lambda value: (pd.isna(value), value))
            texts = ["none stated" if pd.isna(value) else f"{value:g}" for value in values]
            column = self.columns[key]
            mixed.append(f"{column.label} {', '.join(texts)} {column.unit}")
        return f"Several limits together: {'; '.join(mixed)}." if mixed else ""

    @property
    def varied_limits(self) -> list[str]:
        """The columns of limits that vary within an algorithm."""
        grouped = self.frame.groupby("algorithm", sort=False)
        return [key for key in LIMITS if (grouped[key].nunique(dropna=False) > 1).any()]

    def with_limits(self) -> pd.DataFrame:
        """The runs with another column, :data:`UNDER_LIMITS`: the limits that vary, in words; empty if none does.

        Runs of one configuration under different limits are told apart by it.
        """
        columns = [self.columns[key] for key in self.varied_limits]
        known = self.frame[[column.key for column in columns]].itertuples(index=False, name=None)
        words = [
            ", ".join(
                f"{column.label} {'none stated' if pd.isna(value) else f'{value:g} {column.unit}'}"
                for column, value in zip(columns, values, strict=True)
            )
            for values in known
        ]
        return self.frame.assign(**{UNDER_LIMITS: words or [""] * len(self.frame)})

    @property
    def rule_words(self) -> str:
        """The rule as a sentence, and the number of runs that it cannot judge."""
        frame = self.frame
        if TRACKED_PATH not in frame or TRACKED_FRACTION not in frame or self.rule.tracked_path_below is None:
            return self.rule.words
        dated = int((frame[TRACKED_PATH].isna() & frame[TRACKED_FRACTION].notna()).sum())
        if not dated:
            return self.rule.words
        return (
            f"{self.rule.words} {dated} of the runs have old evaluations: they need "
            f"{100 * DATED_FRACTION:g} % of the time tracked. Evaluate them again to apply the rule."
        )

    def with_rows(self, rows: pd.DataFrame) -> RunTable:
        """The table with other rows."""
        return replace(self, frame=rows)

    def described(self, units: Mapping[str, str], repeated: Collection[str]) -> RunTable:
        """The table with units of columns by key, and with the keys of repeated parameters."""
        named = {key: replace(self.columns[key], unit=unit) for key, unit in units.items()}
        return replace(self, columns={**self.columns, **named}, repeated=frozenset(repeated))

    def one_protocol(self, keys: Iterable[str]) -> str | None:
        """The protocol of ``keys`` in words; None if no key depends on one.

        Raises:
            InvalidInput: if the values belong to several protocols, which are never averaged, ranked or drawn together.
        """
        needing = [key for key in keys if self.column(key).needs_protocol]
        if not needing:
            return None
        having = self.frame[self.frame[needing].notna().any(axis=1)]
        mixed = self._mixed(having)
        if mixed is not None:
            raise InvalidInput(
                f"{needing[0]}: {mixed.counts}: not comparable",
                f"choose one with 'protocol: FINGERPRINT', or {mixed.remedy}",
            )
        labels = having["protocol_label"].dropna()
        return str(labels.iloc[0]) if len(labels) else None

    @property
    def mixed_protocols(self) -> MixedProtocols | None:
        """The protocols of the runs if there are several, whose errors no plot draws together."""
        return self._mixed(self.frame) if {"protocol", "protocol_label"} <= set(self.frame) else None

    def _mixed(self, rows: pd.DataFrame) -> MixedProtocols | None:
        counts = rows.groupby(["protocol", "protocol_label"], sort=True).size()
        uses = [ProtocolUse(str(key), str(label), None, int(runs)) for (key, label), runs in counts.items()]
        return mixed_protocols(uses, self.definitions)

    def varied(self) -> list[Column]:
        """The parameters that vary within an algorithm; among equal columns, the first.

        A parameter that varies only between algorithms is part of the algorithm.
        """
        found: dict[tuple[str, ...], Column] = {}
        grouped = self.frame.groupby("algorithm", sort=False)
        for column in self.columns.values():
            asked = column.kind is ColumnKind.PARAMETER and column.key not in self.repeated
            if asked and (grouped[column.key].nunique(dropna=False) > 1).any():
                found.setdefault(tuple(map(str, self.frame[column.key])), column)
        return list(found.values())


def make_table(
    facts: Mapping[str, Iterable[object]],
    parameters: Mapping[str, Iterable[object]],
    metrics: Mapping[str, Iterable[float | None]],
    rule: FailureRule | None = None,
    installed: Mapping[str, str] | None = None,
    attributes: Iterable[Collection[str]] = (),
) -> RunTable:
    """A table from columns with one entry for each run.

    Args:
        facts: By the keys of :data:`FACTS`; at least ``run_id``, ``algorithm``, ``dataset`` and ``state``.
        parameters: By key or general name; None where a run lacks the parameter.
        metrics: By catalogue key; None where a run lacks the metric.
        rule: When a run counts as failed; the default rule if None.
        installed: The sensor set-up of each installed algorithm, including those without runs.
        attributes: Those of the dataset of each run. Each of their properties is a column, unless a parameter has its
            name.
    """
    rows = {key: list(values) for key, values in facts.items()}
    count = len(next(iter(rows.values()), []))
    missing = {column.key: np.full(count, np.nan) if column.numeric else [None] * count for column in FACTS}
    frame = pd.DataFrame(missing | {key: rows[key] for key in missing if key in rows})
    columns = {column.key: column for column in FACTS}
    extra: dict[str, object] = {}
    for key, values in parameters.items():
        entries = list(values)
        numeric = all(entry is None or _is_number(entry) for entry in entries)
        if numeric:
            extra[key] = np.array([np.nan if entry is None else entry for entry in entries], dtype=float)
        else:
            extra[key] = np.array([None if entry is None else str(entry) for entry in entries], dtype=object)
        columns[key] = Column(key, key, ColumnKind.PARAMETER, numeric=numeric)
    words = [tuple(entry) for entry in attributes]
    known_words = set(words)
    for kind in ATTRIBUTE_KINDS if words else ():
        if kind.name not in columns:
            value_of = {entry: kind.of(entry) for entry in known_words}
            extra[kind.name] = np.array([value_of[entry] for entry in words], dtype=object)
            columns[kind.name] = Column(kind.name, kind.label, ColumnKind.FACT, numeric=False)
    for key, entries_of_metric in metrics.items():
        extra[key] = np.array(list(entries_of_metric), dtype=float)  # None becomes NaN
        columns[key] = metric_column(key)
    if extra:
        frame = pd.concat([frame, pd.DataFrame(extra, index=frame.index)], axis=1)
    chosen = rule or FailureRule()
    known = installed or {}
    algorithms = {str(name) for name in frame["algorithm"]}
    return RunTable(
        frame=mark_failures(frame, chosen),
        columns=columns,
        rule=chosen,
        colours=algorithm_colours(algorithms, algorithms),  # each report takes the first colours of the palette
        markers=dataset_markers(map(str, frame["dataset"])),
        installed=known,
    )


def is_disturbed(frame: pd.DataFrame) -> pd.Series:
    """Mark the runs that are known to have been disturbed."""
    return frame["disturbed"].notna() & (frame["disturbed"] != UNDISTURBED)


def mark_failures(frame: pd.DataFrame, rule: FailureRule) -> pd.DataFrame:
    """``frame`` with the column :data:`FAILED`."""
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


def _text(value: object) -> str:
    return f"{value:g}" if isinstance(value, float | np.floating) else str(value)


def _is_number(entry: object) -> bool:
    return isinstance(entry, int | float | np.number)
