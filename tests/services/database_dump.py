"""All rows of a database as values that two databases of the same content share."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from datetime import datetime
from typing import Any

from sqlalchemy import Connection, select

from slamhive.domain.run import RunState
from slamhive.store import Store
from slamhive.store.migrate import METADATA

Row = dict[str, Any]
Dump = dict[str, list[Row]]

FREE_NUMBERS = {
    "algorithms": ("name",),
    "algorithm_versions": ("package", "identity", "package_hash"),
    "analyses": ("token",),
    "datasets": ("name",),
    "experiments": ("uid",),
    "hosts": ("fingerprint",),
    "metrics": ("key",),
    "parameters": ("scope", "key", "type", "unit"),
    "protocols": ("fingerprint",),
    "saved_searches": ("name",),
}
"""Tables whose numbers mean nothing to users, and what tells their rows apart."""

IN_ORDER = {"run_events": "run_id", "evaluations": "run_id"}
"""Tables whose rows have no name: only the order of those of one run is compared."""

IN_NO_FILE = {"accounts", "account_identities", "account_keys", "audit_log"}
"""Tables of which no file holds anything, so that they are lost with a database."""

NOT_COMPARED = {"lease_owner", "lease_expires_at", "owner"}
"""Who works on something, or asked for it: nobody does when a database was lost, and accounts are lost with it."""


def dump(store: Store) -> Dump:
    """Every row of every table, references and all."""
    return store.read(lambda t: _dump(t.database))


def counts(found: Dump) -> dict[str, int]:
    """How many rows each table has."""
    return {name: len(rows) for name, rows in sorted(found.items())}


def differences(one: Dump, other: Dump) -> list[str]:
    """What the two do not share, a line for each row."""
    lines = []
    for name in sorted((one.keys() | other.keys()) - IN_NO_FILE):
        left, right = one.get(name, []), other.get(name, [])
        lines += [f"- {name} {row}" for row in left if row not in right]
        lines += [f"+ {name} {row}" for row in right if row not in left]
        if len(left) != len(right):
            lines.append(f"{name}: {len(left)} and {len(right)} rows")
    return lines


def _dump(connection: Connection) -> Dump:
    tables = METADATA.sorted_tables
    rows = {table.name: [dict(row._mapping) for row in connection.execute(select(table))] for table in tables}
    known: dict[str, dict[int, Any]] = defaultdict(dict)
    found: Dump = {}
    for table in tables:
        references = {
            column.name: key.column.table.name
            for column in table.columns
            for key in column.foreign_keys
            if key.column.table.name in FREE_NUMBERS
        }
        if table.name == "metric_values":
            references["protocol_id"] = "protocols"
        named = [_named(row, references, known) for row in rows[table.name]]
        if table.name in FREE_NUMBERS:
            for row in named:
                known[table.name][row.pop("id")] = tuple(row[key] for key in FREE_NUMBERS[table.name])
        if table.name in IN_ORDER:
            named = _numbered(named, IN_ORDER[table.name])
        found[table.name] = sorted(map(_settled(table.name), named), key=repr)
    # A deleted run leaves the keys of its metrics. A key without a value is content of no database.
    used = {row["metric_id"] for row in found["metric_values"]}
    found["metrics"] = [row for row in found["metrics"] if (row["key"],) in used]
    return found


def _named(row: Row, references: dict[str, str], known: dict[str, dict[int, Any]]) -> Row:
    return {
        name: known[references[name]][value] if name in references and value is not None else value
        for name, value in row.items()
    }


def _numbered(rows: list[Row], group: str) -> list[Row]:
    """The rows with their place among those of the same group instead of a number."""
    places: dict[Any, int] = defaultdict(int)
    numbered = []
    for row in sorted(rows, key=lambda row: row["id"]):
        places[row[group]] += 1
        numbered.append({**row, "id": places[row[group]]})
    return numbered


def _settled(table: str) -> Callable[[Row], Row]:
    """Rows as they are when nobody works on them."""

    def settle(row: Row) -> Row:
        row = {name: _plain(value) for name, value in row.items() if name not in NOT_COMPARED}
        if table == "runs" and RunState(row["state"]).ended:
            row["cancel_requested"] = None
        if table == "evaluations" and row["ended_at"] is None:
            row |= {"state": "waits", "attempt": 0, "started_at": None}
        if table == "analyses":
            row["attempt"] = None  # counts only while it waits
        return row

    return settle


def _plain(value: Any) -> Any:
    return value.isoformat() if isinstance(value, datetime) else value
