"""Indexes that count the runs of an experiment by state, reason and whether they were evaluated."""

from __future__ import annotations

from alembic import op

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None

RUNS = "runs"
NEW = {
    "ix_runs_experiment_cells": ["experiment_id", "cell", "state", "reason", "current_protocol_id"],
    "ix_runs_experiment_states": ["experiment_id", "state", "reason", "current_protocol_id"],
}
OLD = {
    "ix_runs_experiment": ["experiment_id", "cell", "state", "reason"],
    "ix_runs_experiment_counts": ["experiment_id", "state", "reason"],
}


def upgrade() -> None:
    """Replace them; the reference to the experiment needs one of them at any time."""
    _replace(OLD, NEW)


def downgrade() -> None:
    """Put the shorter ones back."""
    _replace(NEW, OLD)


def _replace(old: dict[str, list[str]], new: dict[str, list[str]]) -> None:
    for name, columns in new.items():
        op.create_index(name, RUNS, columns)
    for name in old:
        op.drop_index(name, RUNS)
