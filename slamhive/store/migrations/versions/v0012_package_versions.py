"""Versions belong to packages and have numbers: in the order of the first run that used them."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import mysql

revision = "0012"
down_revision = "0011"
branch_labels = None
depends_on = None

MOMENT = sa.DateTime().with_variant(mysql.DATETIME(fsp=6), "mysql")
TABLE, INDEX = "algorithm_versions", "ix_runs_algorithm_version_id"
IMPLIED = "fk_runs_algorithm_version_id"
"""MySQL makes it for the reference, and drops it by itself while nobody has made it on purpose."""

OWNER = f"fk_{TABLE}_algorithm_id"
FORMER = f"uq_{TABLE}_algorithm_id_identity_package_hash"
NUMBERS, CONTENT = f"uq_{TABLE}_package_number", f"uq_{TABLE}_package_identity_package_hash"

ALGORITHMS = sa.table("algorithms", sa.column("id"), sa.column("package"))
RUNS = sa.table("runs", sa.column("id"), sa.column("algorithm_version_id"))
VERSIONS = sa.table(
    TABLE,
    *map(sa.column, ("id", "algorithm_id", "package", "number", "identity", "package_hash", "created_at")),
)


def upgrade() -> None:
    """Merge the versions of the modes of a package, and number them."""
    _replace_index(IMPLIED, INDEX)
    for column in (
        sa.Column("package", sa.String(64), nullable=True),
        sa.Column("number", sa.Integer(), nullable=True),
        sa.Column("removed_at", MOMENT, nullable=True),
    ):
        op.add_column(TABLE, column)
    connection = op.get_bind()
    first_run = sa.select(sa.func.min(RUNS.c.id)).where(RUNS.c.algorithm_version_id == VERSIONS.c.id)
    query = sa.select(VERSIONS, ALGORITHMS.c.package.label("owner"), first_run.scalar_subquery().label("first_run"))
    rows = connection.execute(query.join(ALGORITHMS, ALGORITHMS.c.id == VERSIONS.c.algorithm_id)).all()
    kept: dict[tuple[str, str, str], int] = {}
    last: dict[str, int] = {}
    for row in sorted(rows, key=lambda row: (row.first_run is None, row.first_run or 0, row.created_at, row.id)):
        content = row.owner, row.identity, row.package_hash
        if content in kept:
            same = RUNS.c.algorithm_version_id == row.id
            connection.execute(sa.update(RUNS).where(same).values(algorithm_version_id=kept[content]))
            connection.execute(sa.delete(VERSIONS).where(VERSIONS.c.id == row.id))
            continue
        kept[content] = row.id
        last[row.owner] = last.get(row.owner, 0) + 1
        values = {"package": row.owner, "number": last[row.owner]}
        connection.execute(sa.update(VERSIONS).where(VERSIONS.c.id == row.id).values(values))
    with op.batch_alter_table(TABLE) as table:
        table.drop_constraint(OWNER, type_="foreignkey")
        table.drop_constraint(FORMER, type_="unique")
        table.drop_column("algorithm_id")
        table.alter_column("package", existing_type=sa.String(64), nullable=False)
        table.alter_column("number", existing_type=sa.Integer(), nullable=False)
        table.create_unique_constraint(NUMBERS, ["package", "number"])
        table.create_unique_constraint(CONTENT, ["package", "identity", "package_hash"])


def downgrade() -> None:
    """Give each version to one mode of its package."""
    op.add_column(TABLE, sa.Column("algorithm_id", sa.Integer(), nullable=True))
    first = sa.select(sa.func.min(ALGORITHMS.c.id)).where(ALGORITHMS.c.package == VERSIONS.c.package)
    op.execute(sa.update(VERSIONS).values(algorithm_id=first.scalar_subquery()))
    with op.batch_alter_table(TABLE) as table:
        table.drop_constraint(NUMBERS, type_="unique")
        table.drop_constraint(CONTENT, type_="unique")
        for name in ("package", "number", "removed_at"):
            table.drop_column(name)
        table.alter_column("algorithm_id", existing_type=sa.Integer(), nullable=False)
        table.create_unique_constraint(FORMER, ["algorithm_id", "identity", "package_hash"])
        table.create_foreign_key(OWNER, "algorithms", ["algorithm_id"], ["id"])
    _replace_index(INDEX, IMPLIED)


def _replace_index(old: str, new: str) -> None:
    """Index the versions of runs under another name. SQLite has no index that a reference implies."""
    connection = op.get_bind()
    mysql = connection.dialect.name == "mysql"
    if new == INDEX or mysql:
        op.create_index(new, "runs", ["algorithm_version_id"])
    if old in {index["name"] for index in sa.inspect(connection).get_indexes("runs")}:
        op.drop_index(old, "runs")
