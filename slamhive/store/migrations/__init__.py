"""Alembic's scripts. :mod:`slamhive.store.migrate` runs them; nothing else imports them."""
