"""Entry point of Alembic: runs migrations on the connection that :mod:`slamhive.store.migrate` gives it."""

from __future__ import annotations

from alembic import context

from slamhive.store.migrate import METADATA

context.configure(
    connection=context.config.attributes["connection"],
    target_metadata=METADATA,
    render_as_batch=True,
)
with context.begin_transaction():
    context.run_migrations()
