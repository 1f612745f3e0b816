"""The columns of the runs table: every column of a run, and every metric of the catalogue."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from types import MappingProxyType

from slamhive.domain.metrics import CATALOGUE, Metric
from slamhive.domain.verdict import DEFAULT_RULE
from slamhive.errors import unknown
from slamhive.search.fields import PARAMETER_PREFIX, Vocabulary
from slamhive.search.fields import Kind as FieldKind
from slamhive.store.records import RunRecord
from slamhive.web.formatting import DASH, Cell, display_unit, exact_time, metric_cell, value_text


class Kind(StrEnum):
    """How the template draws a cell. All kinds but TEXT and NUMBER have their own markup."""

    TEXT = "text"
    NUMBER = "number"
    RUN = "run"
    ALGORITHM = "algorithm"
    DATASET = "dataset"
    STATE = "state"
    TIME = "time"
    PARAMETERS = "parameters"
    EXPERIMENT = "experiment"
    VERDICT = "verdict"
    EDITED = "edited"


@dataclass(frozen=True, slots=True)
class Column:
    """One column: heading, unit, sort key (None if not sortable), and the function that makes its cell for a run."""

    key: str
    title: str
    kind: Kind
    cell: Callable[[RunRecord], Cell]
    unit: str = ""
    sort: str | None = None
    help: str = ""

    @property
    def numeric(self) -> bool:
        """Whether cells are right-aligned with tabular digits."""
        return self.kind in (Kind.NUMBER, Kind.RUN)


DEFAULT_COLUMNS = (
    "id",
    "algorithm",
    "dataset",
    "variant",
    "parameters",
    "state",
    "verdict",
    "created_at",
    "ate.rmse",
    "rpe.rmse",
    "tracked_fraction",
    "cpu.mean",
    "ram.max",
)


@cache
def all_columns() -> Mapping[str, Column]:
    """Every column by key, in display order."""
    own = (
        Column("id", "Run", Kind.RUN, lambda run: Cell(str(run.id)), sort="id"),
        Column("algorithm", "Algorithm", Kind.ALGORITHM, lambda run: Cell(run.algorithm), sort="algorithm"),
        Column("version", "Version", Kind.TEXT, _version, help="version of the package that ran"),
        Column("dataset", "Dataset", Kind.DATASET, lambda run: Cell(run.dataset), sort="dataset"),
        Column("variant", "Pre-processing", Kind.TEXT, variant_cell, help="steps applied to the dataset"),
        Column(
            "trajectory",
            "Trajectory",
            Kind.TEXT,
            lambda run: Cell(run.trajectory) if run.trajectory else Cell(DASH, "not stated", missing=True),
            help="live, final or keyframes",
        ),
        Column(
            "parameters", "Parameters", Kind.PARAMETERS, _parameters, help="only values that differ from the default"
        ),
        Column(
            "configuration",
            "Configuration",
            Kind.NUMBER,
            lambda run: Cell(str(run.configuration_id)),
            sort="configuration",
        ),
        Column(
            "experiment", "Experiment", Kind.EXPERIMENT, _experiment, sort="experiment", help="experiment of the run"
        ),
        Column("executor", "Executor", Kind.TEXT, lambda run: Cell(run.executor), sort="executor"),
        Column(
            "owner",
            "Owner",
            Kind.TEXT,
            lambda run: _text(run.owner or ""),
            sort="owner",
            help="account that it belongs to",
        ),
        Column("visibility", "Visibility", Kind.TEXT, lambda run: Cell(run.seen_by.value), help="who may see it"),
        Column("playback", "Playback", Kind.TEXT, _playback),
        Column("seed", "Seed", Kind.NUMBER, lambda run: Cell(str(run.seed)), sort="seed"),
        Column("state", "State", Kind.STATE, lambda run: Cell(run.state.value), sort="state"),
        Column("reason", "Reason", Kind.TEXT, _reason, sort="reason", help="why the run failed"),
        Column("verdict", "Verdict", Kind.VERDICT, _verdict, help=DEFAULT_RULE.words),
        Column("trust", "Trust", Kind.TEXT, _trust, help="how far the measurements can be trusted, and why"),
        Column("disturbed", "Disturbed", Kind.TEXT, _disturbed, help="whether other load disturbed the run, and which"),
        Column("tags", "Tags", Kind.EDITED, lambda run: _text(", ".join(run.tags)), help="given by somebody"),
        Column("note", "Note", Kind.EDITED, lambda run: _text(run.note or ""), help="written by somebody"),
        _time_column("created_at", "Created"),
        _time_column("started_at", "Started"),
        _time_column("ended_at", "Ended"),
        Column("protocol", "Protocol", Kind.TEXT, _protocol, help="protocol of the errors shown"),
    )
    return MappingProxyType({column.key: column for column in (*own, *map(_metric_column, CATALOGUE.values()))})


def column(key: str, vocabulary: Vocabulary | None = None) -> Column:
    """The column ``key``, which may be a parameter; raises NotFound with similar names."""
    columns = all_columns()
    if key in columns:
        return columns[key]
    name = key.removeprefix(PARAMETER_PREFIX)
    parameters = {} if vocabulary is None else vocabulary.parameters
    if vocabulary is None or name not in parameters:
        raise unknown("column", key, [*columns, *parameters])
    return _parameter_column(key, name, vocabulary)


def _parameter_column(key: str, name: str, vocabulary: Vocabulary) -> Column:
    """A parameter column, by key or by a general name that several algorithms share."""
    own_keys = vocabulary.own_keys.get(name, (name,))
    first = vocabulary.parameters[name][0]

    def cell(run: RunRecord) -> Cell:
        value = next((run.parameters[own] for own in own_keys if own in run.parameters), None)
        return Cell(DASH, f"no {name}", missing=True) if value is None else Cell(value_text(value))

    kind = Kind.NUMBER if first.kind is FieldKind.NUMBER else Kind.TEXT
    sort = key if first.kind is FieldKind.NUMBER else None
    return Column(key, name, kind, cell, first.unit, sort, "parameter of the algorithm")


def _time_column(key: str, title: str) -> Column:
    return Column(key, title, Kind.TIME, lambda run: Cell(exact_time(getattr(run, key))), sort=key)


def _metric_column(metric: Metric) -> Column:
    return Column(
        key=metric.key,
        title=metric.label,
        kind=Kind.NUMBER,
        cell=lambda run: metric_cell(metric, (run.metrics or {}).get(metric.key)),
        unit=display_unit(metric).unit,
        sort=metric.key,
        help=metric.definition,
    )


def variant_cell(run: RunRecord) -> Cell:
    """The steps in short, with their sensors on hover; a dash for the original dataset."""
    text = "; ".join(step.brief for step in run.variant)
    return Cell(text, "; ".join(map(str, run.variant))) if text else Cell(DASH, "original dataset", missing=True)


def _parameters(run: RunRecord) -> Cell:
    text = ", ".join(f"{key}={value_text(value)}" for key, value in run.parameters.items())
    return Cell(text or DASH, text)


def _experiment(run: RunRecord) -> Cell:
    return Cell(DASH, missing=True) if run.experiment is None else Cell(run.experiment)


def _version(run: RunRecord) -> Cell:
    if run.version is None:
        return Cell(DASH, "not started", missing=True)
    return Cell(run.version_label or DASH, f"{run.version.version}, {run.version.identity}")


def _playback(run: RunRecord) -> Cell:
    return Cell(f"{run.playback.mode.value} × {run.playback.rate:g}")


def _reason(run: RunRecord) -> Cell:
    if run.reason is None:
        return Cell(DASH, missing=True)
    return Cell(run.reason.value.replace("_", " "), run.detail or "")


def _text(text: str) -> Cell:
    return Cell(" ".join(text.split()), text) if text else Cell(DASH, missing=True)


def _verdict(run: RunRecord) -> Cell:
    verdict = run.verdict
    if verdict is None:
        return Cell(DASH, "not judged: cancelled, unfinished or not evaluated", missing=True)
    return Cell(verdict.kind.label, verdict.words)


def _trust(run: RunRecord) -> Cell:
    found = run.trust
    if found is None or found.level is None:
        return Cell(DASH, "not measured" if found is None else found.words, missing=True)
    return Cell(found.level.value, found.words)


def _disturbed(run: RunRecord) -> Cell:
    found = run.disturbance
    if found is None or found.disturbed is None:
        return Cell(DASH, "not recorded", missing=True)
    if not found.disturbed:
        return Cell("no")
    return Cell(", ".join(reason.kind.label for reason in found.reasons), found.words)


def _protocol(run: RunRecord) -> Cell:
    if run.protocol is None:
        return Cell(DASH, "not evaluated", missing=True)
    return Cell(run.protocol.label, f"fingerprint {run.protocol.fingerprint}")
