"""Configurations for tables and pages."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from slamhive.base.errors import InvalidInput
from slamhive.documents.catalogue import BoundParameter, MatchDocument
from slamhive.documents.submission import Submission
from slamhive.domain.algorithm import Algorithm
from slamhive.domain.matching import Origin
from slamhive.domain.parameters import Parameter, check_stored
from slamhive.services.configurations import Label, Stored
from slamhive.store import ConfigurationRecord, RunRecord
from slamhive.web.columns import ListColumn, column
from slamhive.web.formatting import DASH, TableCell, plural, value_text
from slamhive.web.presenters.runs import ListRow, ParameterRow, changed_cell
from slamhive.web.presenters.runs import rows as rows_of_runs

Store = Callable[[Submission, Label], Stored]
_RUN_COLUMNS = ("id", "state", "seed", "executor", "created_at", "ate.rmse", "rpe.rmse", "tracked_fraction")


@dataclass(frozen=True, slots=True)
class ListedConfiguration:
    """One configuration in a table: parameters that differ from their defaults, and the steps."""

    record: ConfigurationRecord
    parameters: TableCell
    variant: str


@dataclass(frozen=True, slots=True)
class StoredParameterRow(ParameterRow):
    """One stored value with its definition at that time; ``default`` is the current one."""

    general: str
    type: str


def rows(records: Iterable[ConfigurationRecord], algorithms: Mapping[str, Algorithm]) -> list[ListedConfiguration]:
    """Table rows."""
    definitions = {name: algorithm.parameters for name, algorithm in algorithms.items()}
    return [
        ListedConfiguration(
            record,
            changed_cell(record.configuration.algorithm, record.configuration.parameters, definitions),
            "; ".join(map(str, record.configuration.variant)),
        )
        for record in records
    ]


def run_columns() -> list[ListColumn]:
    """The columns of the runs of one configuration."""
    return [column(key) for key in _RUN_COLUMNS]


def run_rows(runs: Iterable[RunRecord], algorithms: Iterable[Algorithm]) -> list[ListRow]:
    """The runs of one configuration."""
    return rows_of_runs(runs, run_columns(), algorithms)


def parameter_rows(
    record: ConfigurationRecord, algorithm: Algorithm | None, match: MatchDocument | None
) -> list[StoredParameterRow]:
    """All values, with those that differ from the default, or from what the sensors say, marked."""
    bound = {} if match is None else match.parameters
    known = {} if algorithm is None else {parameter.key: parameter for parameter in algorithm.parameters}
    found = []
    for key, value in record.configuration.parameters.items():
        if key in bound:
            continue
        stored, now = record.parameters[key], known.get(key)
        found.append(
            StoredParameterRow(
                key=key,
                general=stored.general or "",
                type=stored.type,
                value=value_text(value),
                default=DASH if now is None else value_text(now.default),
                unit=stored.unit,
                help="no longer a parameter of this algorithm" if now is None else now.help,
                changed=now is not None and now.default != value,
            )
        )
    return [*found, *(_bound_row(key, entry, known[key]) for key, entry in bound.items() if key in known)]


def _bound_row(key: str, entry: BoundParameter, definition: Parameter) -> StoredParameterRow:
    return StoredParameterRow(
        key=key,
        general=definition.general or "",
        type=definition.type.value,
        value=value_text(entry.value),
        default=entry.words,
        unit=definition.unit,
        help=definition.help,
        changed=entry.origin is not Origin.SENSOR,
    )


def outdated(record: ConfigurationRecord, algorithm: Algorithm | None) -> str | None:
    """Why the configuration can no longer be run, None if it can."""
    content = record.configuration
    if algorithm is None:
        return f"algorithm {content.algorithm} no longer exists"
    try:
        check_stored(algorithm.name, algorithm.parameters, content.parameters)
    except InvalidInput as error:
        return str(error)
    return None


def held_by(record: ConfigurationRecord) -> str | None:
    """Why the configuration cannot be deleted, None if it can."""
    if record.experiments:
        return f"it is part of experiment {record.experiments[0]}"
    return f"it has {plural(record.runs, 'run')}" if record.runs else None
