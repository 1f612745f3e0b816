"""The columns of the runs table: every column of a run, and every metric of the catalogue."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from types import MappingProxyType
from typing import Any

from werkzeug.datastructures import MultiDict

from slamhive.base.bounds import whole_number
from slamhive.base.errors import InvalidInput, unknown
from slamhive.domain.finding import MOST_PINNED
from slamhive.domain.metrics import CATALOGUE, Metric
from slamhive.domain.verdict import DEFAULT_RULE, outcome_words
from slamhive.filters.fields import PARAMETER_PREFIX, FieldKind, Vocabulary
from slamhive.store.records import RunRecord, SavedSearchRecord
from slamhive.web.formatting import DASH, TableCell, display_unit, exact_time, metric_cell, value_text


class ColumnKind(StrEnum):
    """The way that the template draws a cell. All kinds but TEXT and NUMBER have their own markup."""

    TEXT = "text"
    NUMBER = "number"
    RUN = "run"
    ALGORITHM = "algorithm"
    DATASET = "dataset"
    STATE = "state"
    OUTCOME = "outcome"
    TIME = "time"
    PARAMETERS = "parameters"
    EXPERIMENT = "experiment"
    VERDICT = "verdict"
    EDITED = "edited"
    DIFFERS = "differs"


@dataclass(frozen=True, slots=True)
class ListColumn:
    """One column: heading, unit, sort key (None if not sortable), and the function that makes its cell for a run."""

    key: str
    title: str
    kind: ColumnKind
    cell: Callable[[RunRecord], TableCell]
    unit: str = ""
    sort: str | None = None
    help: str = ""

    @property
    def numeric(self) -> bool:
        """True if cells are right-aligned with tabular digits."""
        return self.kind in (ColumnKind.NUMBER, ColumnKind.RUN)


DEFAULT_COLUMNS = ("id", "algorithm", "dataset", "differs", "outcome", "ate.rmse", "tracked_fraction")
SPARK_AFTER = "ate.rmse"
"""The column behind which sparklines are drawn; the last one where it is not shown."""


@cache
def all_columns() -> Mapping[str, ListColumn]:
    """Every column by key, in display order."""
    own = (
        ListColumn("id", "Run", ColumnKind.RUN, lambda run: TableCell(str(run.id)), sort="id"),
        ListColumn(
            "algorithm", "Algorithm", ColumnKind.ALGORITHM, lambda run: TableCell(run.algorithm), sort="algorithm"
        ),
        ListColumn("version", "Version", ColumnKind.TEXT, _version, help="version of the package that ran"),
        ListColumn("dataset", "Dataset", ColumnKind.DATASET, lambda run: TableCell(run.dataset), sort="dataset"),
        ListColumn("variant", "Pre-processing", ColumnKind.TEXT, variant_cell, help="steps applied to the dataset"),
        ListColumn(
            "trajectory",
            "Trajectory",
            ColumnKind.TEXT,
            lambda run: TableCell(run.trajectory) if run.trajectory else TableCell(DASH, "not stated", missing=True),
            help="live, final or keyframes",
        ),
        ListColumn(
            "parameters",
            "Parameters",
            ColumnKind.PARAMETERS,
            _parameters,
            help="only values that differ from the default",
        ),
        ListColumn(
            "configuration",
            "Configuration",
            ColumnKind.NUMBER,
            lambda run: TableCell(str(run.configuration_id)),
            sort="configuration",
        ),
        ListColumn(
            "experiment",
            "Experiment",
            ColumnKind.EXPERIMENT,
            _experiment,
            sort="experiment",
            help="experiment of the run",
        ),
        ListColumn("executor", "Executor", ColumnKind.TEXT, lambda run: TableCell(run.executor), sort="executor"),
        ListColumn(
            "owner",
            "Owner",
            ColumnKind.TEXT,
            lambda run: _text(run.owner or ""),
            sort="owner",
            help="account that it belongs to",
        ),
        ListColumn(
            "visibility", "Visibility", ColumnKind.TEXT, lambda run: TableCell(run.seen_by.value), help="who may see it"
        ),
        ListColumn("playback", "Playback", ColumnKind.TEXT, _playback),
        ListColumn("seed", "Seed", ColumnKind.NUMBER, lambda run: TableCell(str(run.seed)), sort="seed"),
        ListColumn(
            "cpu_cores",
            "CPU limit [cores]",
            ColumnKind.NUMBER,
            lambda run: _limit(run.cpu_cores),
            help="that the run asked for",
        ),
        ListColumn(
            "memory_mb",
            "Memory limit [MB]",
            ColumnKind.NUMBER,
            lambda run: _limit(run.memory_mb),
            help="that the run asked for",
        ),
        ListColumn(
            "slow_down",
            "Slowed down",
            ColumnKind.NUMBER,
            lambda run: TableCell(f"{run.slow_down:g}"),
            help="of each core, the run got 1 / this of the time",
        ),
        ListColumn(
            "differs",
            "What differs",
            ColumnKind.DIFFERS,
            _everything,
            help="parameters and pre-processing that are not the same in all runs of this table",
        ),
        ListColumn(
            "outcome",
            "Outcome",
            ColumnKind.OUTCOME,
            lambda run: TableCell(outcome_words(run)),
            sort="state",
            help="good, or why not; not evaluated, running, queued, cancelled or lost",
        ),
        ListColumn("state", "State", ColumnKind.STATE, lambda run: TableCell(run.state.value), sort="state"),
        ListColumn("reason", "Reason", ColumnKind.TEXT, _reason, sort="reason", help="why the run failed"),
        ListColumn("verdict", "Verdict", ColumnKind.VERDICT, _verdict, help=DEFAULT_RULE.words),
        ListColumn("trust", "Trust", ColumnKind.TEXT, _trust, help="how far the measurements can be trusted, and why"),
        ListColumn(
            "disturbed",
            "Disturbed",
            ColumnKind.TEXT,
            _disturbed,
            help="whether other load disturbed the run, and which",
        ),
        ListColumn("tags", "Tags", ColumnKind.EDITED, lambda run: _text(", ".join(run.tags)), help="given by somebody"),
        ListColumn("note", "Note", ColumnKind.EDITED, lambda run: _text(run.note or ""), help="written by somebody"),
        _time_column("created_at", "Created"),
        _time_column("started_at", "Started"),
        _time_column("ended_at", "Ended"),
        ListColumn("protocol", "Protocol", ColumnKind.TEXT, _protocol, help="protocol of the errors shown"),
    )
    return MappingProxyType({column.key: column for column in (*own, *map(_metric_column, CATALOGUE.values()))})


def column(key: str, vocabulary: Vocabulary | None = None) -> ListColumn:
    """The column ``key``, which may be a parameter; raises NotFound with similar names."""
    columns = all_columns()
    if key in columns:
        return columns[key]
    name = key.removeprefix(PARAMETER_PREFIX)
    parameters = {} if vocabulary is None else vocabulary.parameters
    if vocabulary is None or name not in parameters:
        raise unknown("column", key, [*columns, *parameters])
    # ``name`` is the key of one algorithm, or a general name that stands for the keys of several.
    own_keys = vocabulary.own_keys.get(name, (name,))
    first = parameters[name][0]

    def cell(run: RunRecord) -> TableCell:
        value = next((run.parameters[own] for own in own_keys if own in run.parameters), None)
        return TableCell(DASH, f"no {name}", missing=True) if value is None else TableCell(value_text(value))

    kind = ColumnKind.NUMBER if first.kind is FieldKind.NUMBER else ColumnKind.TEXT
    sort = key if first.kind is FieldKind.NUMBER else None
    return ListColumn(key, name, kind, cell, first.unit, sort, "parameter of the algorithm")


def _time_column(key: str, title: str) -> ListColumn:
    return ListColumn(key, title, ColumnKind.TIME, lambda run: TableCell(exact_time(getattr(run, key))), sort=key)


def _metric_column(metric: Metric) -> ListColumn:
    return ListColumn(
        key=metric.key,
        title=metric.label,
        kind=ColumnKind.NUMBER,
        cell=lambda run: metric_cell(metric, (run.metrics or {}).get(metric.key)),
        unit=display_unit(metric).unit,
        sort=metric.key,
        help=metric.definition,
    )


def variant_cell(run: RunRecord) -> TableCell:
    """The steps in short, with their sensors on hover; a dash for the original dataset."""
    text = "; ".join(step.brief for step in run.variant)
    return (
        TableCell(text, "; ".join(map(str, run.variant))) if text else TableCell(DASH, "original dataset", missing=True)
    )


def _parameters(run: RunRecord) -> TableCell:
    text = ", ".join(f"{key}={value_text(value)}" for key, value in run.parameters.items())
    return TableCell(text or DASH, text)


def exported(columns: Sequence[str]) -> tuple[str, ...]:
    """The columns of a file. What differs depends on the other runs of a table, so a file holds all settings."""
    found = [part for key in columns for part in (("parameters", "variant") if key == "differs" else (key,))]
    return tuple(dict.fromkeys(found))


def settings_of(run: RunRecord) -> dict[str, str]:
    """{name: text} of the parameters and the pre-processing of a run."""
    found = {key: value_text(value) for key, value in run.parameters.items()}
    return found | ({"pre-processing": "; ".join(step.brief for step in run.variant)} if run.variant else {})


def _everything(run: RunRecord) -> TableCell:
    text = ", ".join(f"{name}={value}" for name, value in settings_of(run).items())
    return TableCell(text or DASH, text)


def _experiment(run: RunRecord) -> TableCell:
    return TableCell(DASH, missing=True) if run.experiment is None else TableCell(run.experiment)


def _version(run: RunRecord) -> TableCell:
    if run.version is None:
        return TableCell(DASH, "not started", missing=True)
    return TableCell(run.version_label or DASH, f"{run.version.version}, {run.version.identity}")


def _playback(run: RunRecord) -> TableCell:
    return TableCell(f"{run.playback.mode.value} × {run.playback.rate:g}")


def _reason(run: RunRecord) -> TableCell:
    if run.reason is None:
        return TableCell(DASH, missing=True)
    return TableCell(run.reason.value.replace("_", " "), run.detail or "")


def _limit(value: float | None) -> TableCell:
    return TableCell(DASH, "not stated", missing=True) if value is None else TableCell(f"{value:g}")


def _text(text: str) -> TableCell:
    return TableCell(" ".join(text.split()), text) if text else TableCell(DASH, missing=True)


def _verdict(run: RunRecord) -> TableCell:
    verdict = run.verdict
    if verdict is None:
        return TableCell(DASH, "not judged: cancelled, unfinished or not evaluated", missing=True)
    return TableCell(verdict.kind.label, verdict.words)


def _trust(run: RunRecord) -> TableCell:
    found = run.trust
    if found is None or found.level is None:
        return TableCell(DASH, "not measured" if found is None else found.words, missing=True)
    return TableCell(found.mark, found.words)


def _disturbed(run: RunRecord) -> TableCell:
    found = run.disturbance
    if found is None or found.disturbed is None:
        return TableCell(DASH, "not recorded", missing=True)
    if not found.disturbed:
        return TableCell("no")
    return TableCell(", ".join(reason.kind.label for reason in found.reasons), found.words)


def _protocol(run: RunRecord) -> TableCell:
    if run.protocol is None:
        return TableCell(DASH, "not evaluated", missing=True)
    return TableCell(run.protocol.label, f"fingerprint {run.protocol.fingerprint}")


# -- the look of the list of runs: pinned columns, colours by value, sparklines ----------------------------------------


PINNED = 1
"""Columns that stay in view if an address names no number: that of the run."""


@dataclass(frozen=True, slots=True)
class ListLook:
    """The first ``pinned`` columns stay in view when the table is scrolled sideways.

    ``colours`` gives metrics a background by their value. ``sparks`` shows the error of each run over time, or the
    repeats of each configuration.
    """

    pinned: int = PINNED
    colours: bool = True
    sparks: bool = True

    @classmethod
    def from_args(cls, args: MultiDict[str, str]) -> ListLook:
        """Read an address; raises InvalidInput naming the invalid value."""
        text = args.get("pinned", "").strip()
        pinned = whole_number(text, "pinned", 0, MOST_PINNED) if text else PINNED
        return cls(pinned, _chosen(args, "colours"), _chosen(args, "sparks"))

    @classmethod
    def of(cls, saved: SavedSearchRecord) -> ListLook:
        """The look of a saved search."""
        return cls(saved.pinned, saved.colours, saved.sparks)

    def args(self) -> dict[str, Any]:
        """The arguments of an address, without defaults."""
        pinned = {} if self.pinned == PINNED else {"pinned": [str(self.pinned)]}
        chosen = {"colours": self.colours, "sparks": self.sparks}
        return pinned | {name: ["no"] for name, value in chosen.items() if not value}


def _chosen(args: MultiDict[str, str], name: str) -> bool:
    text = args.get(name, "").strip()
    if text not in {"", "yes", "no"}:
        raise InvalidInput(f"{name} expects yes or no, got {text[:40]!r}")
    return text != "no"
