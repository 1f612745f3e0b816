"""Names, notes and groups of configurations; editing the type or unit of a parameter makes another one."""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import mysql

from slamhive.base.errors import Conflict

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None

LONG_TEXT = sa.Text().with_variant(mysql.MEDIUMTEXT(), "mysql")
OPTIONS: dict[str, Any] = {"mysql_engine": "InnoDB", "mysql_charset": "utf8mb4", "mysql_collate": "utf8mb4_bin"}
FORMER, NOW = ("scope", "key"), ("scope", "key", "type", "unit")
LABELS, GROUPS = "configuration_labels", "configuration_groups"


def upgrade() -> None:
    """Add two tables; the parameters there keep the type and unit that they were stored with first."""
    op.create_table(
        LABELS,
        sa.Column("configuration_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("name", sa.String(64), nullable=True),
        sa.Column("note", LONG_TEXT, nullable=False),
        sa.ForeignKeyConstraint(["configuration_id"], ["configurations.id"], name=f"fk_{LABELS}_configuration_id"),
        sa.PrimaryKeyConstraint("configuration_id", name=f"pk_{LABELS}"),
        sa.UniqueConstraint("name", name=f"uq_{LABELS}_name"),
        **OPTIONS,
    )
    op.create_table(
        GROUPS,
        sa.Column("name", sa.String(64), nullable=False),
        sa.Column("configuration_id", sa.Integer(), nullable=False),
        sa.ForeignKeyConstraint(["configuration_id"], ["configurations.id"], name=f"fk_{GROUPS}_configuration_id"),
        sa.PrimaryKeyConstraint("name", "configuration_id", name=f"pk_{GROUPS}"),
        sqlite_with_rowid=False,
        **OPTIONS,
    )
    op.create_index(f"ix_{GROUPS}_configuration_id", GROUPS, ["configuration_id"])
    _change_unique(FORMER, NOW)


def downgrade() -> None:
    """Remove them; raises Conflict where parameters of one key could no longer be told apart."""
    parameters = sa.table("parameters", sa.column("scope"), sa.column("key"))
    both = sa.select(parameters.c.scope, parameters.c.key).group_by(parameters.c.scope, parameters.c.key)
    twice = op.get_bind().execute(both.having(sa.func.count() > 1)).all()
    if twice:
        raise Conflict(
            f"{len(twice)} parameters were stored under several definitions, which the older version cannot hold",
            "use a database of its own for it",
        )
    _change_unique(NOW, FORMER)
    op.drop_table(GROUPS)
    op.drop_table(LABELS)


def _change_unique(old: tuple[str, ...], new: tuple[str, ...]) -> None:
    with op.batch_alter_table("parameters") as table:
        table.create_unique_constraint(f"uq_parameters_{'_'.join(new)}", list(new))
        table.drop_constraint(f"uq_parameters_{'_'.join(old)}", type_="unique")
