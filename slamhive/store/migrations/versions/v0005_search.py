"""Search: metric values ordered by metric, with ``is_current``; variant options, saved searches, indexes.

A migration stands still while the models move on, so it names its own column types and imports none of theirs.
"""

from __future__ import annotations

import json
from typing import Any

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import mysql

from slamhive.base.errors import Conflict

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None

MOMENT = sa.DateTime().with_variant(mysql.DATETIME(fsp=6), "mysql")
LONG_TEXT = sa.Text().with_variant(mysql.MEDIUMTEXT(), "mysql")
NUMBER: sa.types.TypeEngine[Any] = sa.Double().with_variant(mysql.DOUBLE(asdecimal=False), "mysql")
OPTIONS: dict[str, Any] = {"mysql_engine": "InnoDB", "mysql_charset": "utf8mb4", "mysql_collate": "utf8mb4_bin"}

FIGURES, VARIANTS, SAVED = "metric_values", "variant_options", "saved_searches"
REFERENCES = {"run_id": "runs", "metric_id": "metrics", "protocol_id": "protocols"}
RUN_INDEXES = ("executor", "reason", "started_at", "ended_at")
EVALUATED = "ix_runs_current_protocol_id_state"
CURRENT = "fk_runs_current_protocol_id"


def upgrade() -> None:
    """Rebuild the table of metrics, add two tables and indexes; options of the variants there are filed."""
    counts = "v.protocol_id = 1 OR v.protocol_id = r.current_protocol_id"
    read = f"v.metric_id, v.run_id, v.protocol_id, v.value, CASE WHEN {counts} THEN 1 ELSE 0 END"
    copied = f"SELECT {read} FROM {FIGURES} v JOIN runs r ON r.id = v.run_id"  # noqa: S608 - our own names
    columns = ("metric_id", "run_id", "protocol_id")
    current = sa.Column("is_current", sa.SmallInteger(), nullable=False)
    _rebuild_figures(columns, ("run_id", "metric_id"), copied, current)
    op.create_index(f"ix_{FIGURES}_search", FIGURES, ["metric_id", "is_current", "value", "run_id"])
    op.create_index(f"ix_{FIGURES}_run_id", FIGURES, ["run_id"])
    op.create_table(
        VARIANTS,
        sa.Column("configuration_id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(190), nullable=False),
        sa.Column("number_value", NUMBER, nullable=True),
        sa.Column("text_value", sa.String(190), nullable=True),
        sa.ForeignKeyConstraint(["configuration_id"], ["configurations.id"], name=f"fk_{VARIANTS}_configuration_id"),
        sa.PrimaryKeyConstraint("configuration_id", "name", name=f"pk_{VARIANTS}"),
        sqlite_with_rowid=False,
        **OPTIONS,
    )
    for kind in ("number", "text"):
        op.create_index(f"ix_{VARIANTS}_{kind}", VARIANTS, ["name", f"{kind}_value", "configuration_id"])
    op.create_table(
        SAVED,
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(64), nullable=False),
        sa.Column("filter_text", LONG_TEXT, nullable=False),
        sa.Column("shown_columns", LONG_TEXT, nullable=False),
        sa.Column("sort", sa.String(190), nullable=False),
        sa.Column("descending", sa.Boolean(), nullable=False),
        sa.Column("grouped", sa.Boolean(), nullable=False),
        sa.Column("created_at", MOMENT, nullable=False),
        sa.PrimaryKeyConstraint("id", name=f"pk_{SAVED}"),
        sa.UniqueConstraint("name", name=f"uq_{SAVED}_name"),
        **OPTIONS,
    )
    for column in RUN_INDEXES:
        op.create_index(f"ix_runs_{column}", "runs", [column])
    op.create_index(EVALUATED, "runs", ["current_protocol_id", "state"])
    # One row for each option of each kind of step, and for each sensor beside it.
    configurations = sa.table("configurations", sa.column("id"), sa.column("variant"))
    options = sa.table(
        VARIANTS, *(sa.column(name) for name in ("configuration_id", "name", "number_value", "text_value"))
    )
    bind = op.get_bind()
    query = sa.select(configurations).where(configurations.c.variant.is_not(None))
    for configuration_id, variant in bind.execute(query).all():
        found: dict[str, list[Any]] = {}
        for step in json.loads(variant):
            for option, value in step["options"].items():
                for name in (f"{step['kind']}.{option}", *(f"{step['kind']}.{option}@{s}" for s in step["sensors"])):
                    found.setdefault(name, []).append(value)
        rows = [
            {
                "configuration_id": configuration_id,
                "name": name,
                "number_value": None if isinstance(values[0], str) else float(values[0]),
                "text_value": values[0][:190] if isinstance(values[0], str) else None,
            }
            for name, values in found.items()
            if all(value == values[0] for value in values)
        ]
        if rows:
            bind.execute(options.insert(), rows)


def downgrade() -> None:
    """Remove them; raises Conflict where saved searches would be lost."""
    found = op.get_bind().execute(sa.text(f"SELECT count(*) FROM {SAVED}")).scalar_one()  # noqa: S608 - our own name
    if found:
        raise Conflict(
            f"{found} searches are saved, which the older version does not know", "use a database of its own for it"
        )
    mysql_like = op.get_bind().dialect.name != "sqlite"
    if mysql_like:
        op.drop_constraint(CURRENT, "runs", type_="foreignkey")
    op.drop_index(EVALUATED, "runs")
    if mysql_like:
        op.create_foreign_key(CURRENT, "runs", "protocols", ["current_protocol_id"], ["id"])
    for column in RUN_INDEXES:
        op.drop_index(f"ix_runs_{column}", "runs")
    op.drop_table(SAVED)
    op.drop_table(VARIANTS)
    copied = f"SELECT v.run_id, v.metric_id, v.protocol_id, v.value FROM {FIGURES} v"  # noqa: S608 - our own name
    _rebuild_figures(("run_id", "metric_id", "protocol_id"), ("run_id", "metric_id", "protocol_id"), copied)
    op.create_index(f"ix_{FIGURES}_search", FIGURES, ["metric_id", "protocol_id", "value", "run_id"])


def _rebuild_figures(key: tuple[str, ...], references: tuple[str, ...], copied: str, *more: sa.Column[Any]) -> None:
    """The table again with ``key`` as its primary key, filled by the query ``copied``.

    MySQL knows the name of a reference once in a database, so the old table gives up its own first.
    """
    if op.get_bind().dialect.name != "sqlite":
        for name in sa.inspect(op.get_bind()).get_foreign_keys(FIGURES):
            op.drop_constraint(str(name["name"]), FIGURES, type_="foreignkey")
    op.rename_table(FIGURES, f"{FIGURES}_old")
    op.create_table(
        FIGURES,
        *(sa.Column(name, sa.Integer(), nullable=False) for name in key),
        sa.Column("value", NUMBER, nullable=False),
        *more,
        *(
            sa.ForeignKeyConstraint([name], [f"{REFERENCES[name]}.id"], name=f"fk_{FIGURES}_{name}")
            for name in references
        ),
        sa.PrimaryKeyConstraint(*key, name=f"pk_{FIGURES}"),
        sqlite_with_rowid=False,
        **OPTIONS,
    )
    op.execute(f"INSERT INTO {FIGURES} {copied.replace(f'{FIGURES} v', f'{FIGURES}_old v')}")
    op.drop_table(f"{FIGURES}_old")
