"""Configurations: stored once each, found again by content."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from typing import Any

from sqlalchemy import Row, insert, select, type_coerce, update
from sqlalchemy.exc import IntegrityError

from slamhive.base.errors import NotFound
from slamhive.domain import configuration as domain
from slamhive.domain.configuration import Variant
from slamhive.domain.parameters import Parameter, ParameterType, Scalar, Value
from slamhive.store.changes import NewRow, changes_of
from slamhive.store.models import (
    TEXT_VALUE_LENGTH,
    AlgorithmRow,
    ConfigurationRow,
    ConfigurationValueRow,
    DatasetRow,
    ParameterRow,
    VariantOptionRow,
)
from slamhive.store.records import NewConfiguration
from slamhive.store.rows import Repository, chunks, get_or_insert, insert_many, to_json
from slamhive.store.tables import LongText, as_json, from_json


def _options(variant: Variant) -> list[tuple[str, float | None, str | None]]:
    """Rows of ``variant_options``: ``KIND.OPTION`` and ``KIND.OPTION@SENSOR``, where all steps of the kind agree."""
    found: dict[str, list[Scalar]] = {}
    for step in variant:
        for option, value in step.options.items():
            name = f"{step.kind}.{option}"
            for key in (name, *(f"{name}@{sensor}" for sensor in step.sensors)):
                found.setdefault(key, []).append(value)
    return [
        (name, *_searched(values[0])) for name, values in found.items() if all(value == values[0] for value in values)
    ]


_VALUE_COLUMNS = ("configuration_id", "parameter_id", "value", "number_value", "text_value")
_OPTION_COLUMNS = ("configuration_id", "name", "number_value", "text_value")

ROWS_OF_A_STATEMENT = 100
"""PyMySQL sends so few rows as one INSERT, which succeeds or fails as a whole if another transaction inserts the same.
SQLite has one writer at a time."""


class ConfigurationRepository(Repository):
    """Typed parameter values in, the same values and types out."""

    def get_or_create(
        self,
        configuration: domain.Configuration,
        algorithm_id: int,
        dataset_id: int,
        now: datetime,
        definitions: Sequence[Parameter] = (),
    ) -> tuple[int, bool]:
        """The id of ``configuration``, and whether it is new. Equal content is one row, also when two try at once.

        Args:
            configuration: What is run.
            algorithm_id: Row of ``configuration.algorithm``.
            dataset_id: Row of ``configuration.dataset``.
            now: When it was created, if it is new.
            definitions: The algorithm's parameters; a key without one is filed under its value's own type.
        """
        entry = NewConfiguration(configuration, configuration.content_hash, algorithm_id, dataset_id, definitions)
        return self.get_or_create_many([entry], now)[0]

    def get_or_create_many(self, entries: Sequence[NewConfiguration], now: datetime) -> list[tuple[int, bool]]:
        """The same for some hundreds of configurations in a few statements, in the order of ``entries``."""
        known = self._ids_by_hash([entry.content_hash for entry in entries])
        missing = {entry.content_hash: entry for entry in entries if entry.content_hash not in known}
        ours: set[str] = set()
        if missing:
            ours = self._insert(missing, now)
            known.update(self._ids_by_hash(list(missing)))
            new = {known[content_hash]: missing[content_hash] for content_hash in ours}
            self._insert_values(new)
            changes_of(self._connection).configurations += [NewRow(number, entry, now) for number, entry in new.items()]
        return [(known[entry.content_hash], entry.content_hash in ours) for entry in entries]

    def restore(self, entries: Mapping[int, NewConfiguration], created_at: Mapping[int, datetime]) -> dict[int, int]:
        """Store configurations under numbers that are free; {number asked for: number}."""
        known = self._ids_by_hash([entry.content_hash for entry in entries.values()])
        new = {n: entry for n, entry in entries.items() if known.setdefault(entry.content_hash, n) == n}
        if new:
            rows = [{**_row(entry), "id": number, "created_at": created_at[number]} for number, entry in new.items()]
            self._connection.execute(insert(ConfigurationRow.__table__), rows)
            self._insert_values(new)
        return {number: known[entry.content_hash] for number, entry in entries.items()}

    def get(self, configuration_id: int) -> domain.Configuration:
        """The configuration with this id; raises NotFound."""
        row = self._connection.execute(
            select(
                AlgorithmRow.name.label("algorithm"),
                DatasetRow.name.label("dataset"),
                ConfigurationRow.playback_mode,
                ConfigurationRow.playback_rate,
                ConfigurationRow.variant,
                ConfigurationRow.sensors,
                ConfigurationRow.version,
                ConfigurationRow.map,
            )
            .join(AlgorithmRow, AlgorithmRow.id == ConfigurationRow.algorithm_id)
            .join(DatasetRow, DatasetRow.id == ConfigurationRow.dataset_id)
            .where(ConfigurationRow.id == configuration_id)
        ).one_or_none()
        if row is None:
            raise NotFound(f"unknown configuration {configuration_id}")
        return configuration_of(row, self.parameters_of(configuration_id))

    def parameters_of(self, configuration_id: int) -> dict[str, Value]:
        """Every parameter of one configuration with its value, typed as it was stored."""
        return self.parameters_of_all([configuration_id])[configuration_id]

    def parameters_of_all(self, configuration_ids: Iterable[int]) -> dict[int, dict[str, Value]]:
        """The same for many configurations, with one query for each few hundred."""
        wanted = sorted(set(configuration_ids))
        found: dict[int, dict[str, Value]] = {configuration_id: {} for configuration_id in wanted}
        read: dict[str, Value] = {}  # few texts differ, and reading each of them took longer than the query
        for part in chunks(wanted):
            rows = self._connection.execute(
                select(
                    ConfigurationValueRow.configuration_id,
                    ParameterRow.key,
                    type_coerce(ConfigurationValueRow.value, LongText),
                )
                .join(ParameterRow, ParameterRow.id == ConfigurationValueRow.parameter_id)
                .where(ConfigurationValueRow.configuration_id.in_(part))
                .order_by(ConfigurationValueRow.configuration_id, ConfigurationValueRow.parameter_id)
            )
            for configuration_id, key, text in rows.all():
                if text not in read:
                    value = from_json(text)
                    read[text] = tuple(value) if isinstance(value, list) else value
                found[configuration_id][key] = read[text]
        return found

    def _ids_by_hash(self, hashes: Sequence[str]) -> dict[str, int]:
        found: dict[str, int] = {}
        for part in chunks(hashes):
            query = select(ConfigurationRow.content_hash, ConfigurationRow.id).where(
                ConfigurationRow.content_hash.in_(part)
            )
            found.update((row.content_hash, row.id) for row in self._connection.execute(query))
        return found

    def _insert(self, missing: Mapping[str, NewConfiguration], now: datetime) -> set[str]:
        """Insert the rows of ``missing``; the hashes of those that no other transaction inserted first."""
        inserted: set[str] = set()
        for part in chunks(list(missing), ROWS_OF_A_STATEMENT):
            rows = [{**_row(missing[content_hash]), "created_at": now} for content_hash in part]
            try:
                self._connection.execute(insert(ConfigurationRow.__table__), rows)
            except IntegrityError:
                for row in rows:
                    keys = {"content_hash": row.pop("content_hash")}
                    if get_or_insert(self._connection, ConfigurationRow, keys, row)[1]:
                        inserted.add(keys["content_hash"])
            else:
                inserted.update(part)
        return inserted

    def _insert_values(self, entries: Mapping[int, NewConfiguration]) -> None:
        """Insert the parameters and variant options of new configurations, by id."""
        ids: dict[tuple[object, ...], dict[str, int]] = {}
        meanings = _Meanings()
        rows: list[tuple[object, ...]] = []
        options: list[tuple[object, ...]] = []
        # Values and variants that an experiment repeats are one object, which the entries keep.
        columns: dict[int, tuple[object, ...]] = {}
        of_variants: dict[int, list[tuple[str, float | None, str | None]]] = {}
        for configuration_id, entry in entries.items():
            variant = entry.configuration.variant
            if id(variant) not in of_variants:
                of_variants[id(variant)] = _options(variant)
            options += [(configuration_id, *option) for option in of_variants[id(variant)]]
            values = entry.configuration.parameters
            kinds = ((key, type(value)) for key, value in values.items())
            signature = (entry.algorithm_id, meanings.of(entry.definitions), *kinds)
            if signature not in ids:
                ids[signature] = self._parameter_ids(entry.algorithm_id, values, entry.definitions)
            numbers = ids[signature]
            for key, value in values.items():
                if id(value) not in columns:  # ``value`` is JSON, which distinguishes 1, 1.0, true and "1".
                    columns[id(value)] = (as_json(value), *_searched(value))
                rows.append((configuration_id, numbers[key], *columns[id(value)]))
        insert_many(self._connection, ConfigurationValueRow.__table__, _VALUE_COLUMNS, rows, as_stored=_VALUE_COLUMNS)
        insert_many(self._connection, VariantOptionRow.__table__, _OPTION_COLUMNS, options, as_stored=_OPTION_COLUMNS)

    def _parameter_ids(
        self, algorithm_id: int, values: Mapping[str, Value], definitions: Sequence[Parameter]
    ) -> dict[str, int]:
        """The rows of ``parameters`` for the keys of ``values``; all modes of a package share theirs.

        A general name is an alias: the rows of a key have the one that its newest definition gives it.
        """
        scope = self._connection.execute(
            select(AlgorithmRow.package).where(AlgorithmRow.id == algorithm_id)
        ).scalar_one()
        table = ParameterRow.__table__
        rows = self._connection.execute(select(table).where(table.c.scope == scope))
        known = {(row.key, row.type, row.unit): row for row in rows}
        defined = {definition.key: definition for definition in definitions}
        ids: dict[str, int] = {}
        for key, value in values.items():
            kind, unit, general = _description(defined.get(key), value)
            row = known.get((key, kind, unit))
            if row is None:
                keys = {"scope": scope, "key": key, "type": kind, "unit": unit}
                ids[key], _ = get_or_insert(self._connection, ParameterRow, keys, {"general": general})
            else:
                ids[key] = row.id
        renamed = {
            row.key: defined[row.key].general
            for row in known.values()
            if row.key in defined and row.general != defined[row.key].general
        }
        for key, general in renamed.items():
            same = (table.c.scope == scope, table.c.key == key)
            self._connection.execute(update(table).where(*same).values(general=general))
        return ids


class _Meanings:
    """Keys that distinguish lists of definitions: the type and unit of each. Computed once for each list."""

    def __init__(self) -> None:
        self._known: dict[int, tuple[object, ...]] = {}

    def of(self, definitions: Sequence[Parameter]) -> tuple[object, ...]:
        """The same for definitions that mean the same; the caller keeps ``definitions``."""
        if id(definitions) not in self._known:
            self._known[id(definitions)] = tuple((d.key, d.type, d.unit, d.general) for d in definitions)
        return self._known[id(definitions)]


def _row(entry: NewConfiguration) -> dict[str, Any]:
    configuration = entry.configuration
    return {
        "content_hash": entry.content_hash,
        "algorithm_id": entry.algorithm_id,
        "dataset_id": entry.dataset_id,
        "playback_mode": configuration.playback.mode,
        "playback_rate": configuration.playback.rate,
        "variant": to_json(Variant, configuration.variant),
        "sensors": dict(configuration.sensors) or None,
        "version": configuration.version,
        "map": to_json(domain.InputMap, configuration.map),
    }


def configuration_of(row: Row[Any], parameters: dict[str, Value]) -> domain.Configuration:
    """The configuration of a row with the names of its algorithm and dataset."""
    return domain.Configuration(
        algorithm=row.algorithm,
        dataset=row.dataset,
        parameters=parameters,
        playback=domain.Playback(row.playback_mode, row.playback_rate),
        variant=domain.variant_of(row.variant),
        sensors=row.sensors or {},
        version=row.version,
        map=None if row.map is None else domain.InputMap(**row.map),
    )


def _description(definition: Parameter | None, value: Value) -> tuple[str, str, str | None]:
    """Type, unit and general name."""
    if definition is not None:
        return definition.type.value, definition.unit, definition.general
    types = {bool: ParameterType.BOOL, int: ParameterType.INT, float: ParameterType.FLOAT, str: ParameterType.STRING}
    return types.get(type(value), ParameterType.MATRIX).value, "", None


def _searched(value: Value) -> tuple[float | None, str | None]:
    """The columns that searches read: a number or a text, neither for a matrix."""
    number: float | None = None
    text: str | None = None
    if isinstance(value, str):
        text = value[:TEXT_VALUE_LENGTH]
    elif not isinstance(value, tuple):
        try:
            number = float(value)
        except OverflowError:  # an integer beyond the largest float
            text = str(value)[:TEXT_VALUE_LENGTH]
    return number, text
