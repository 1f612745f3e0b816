"""What leaves an installation that has accounts: what is public, unless somebody asks for all of it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from slamhive.domain.visibility import ANYBODY
from slamhive.store import Store


@contextmanager
def published(store: Store, *, unpublished: bool = False) -> Iterator[None]:
    """In the block, this thread finds only what is public, if the installation has accounts.

    ``unpublished``: it finds everything all the same.
    """
    hides = not unpublished and store.read(lambda t: t.accounts.in_use())
    with store.seen_by(ANYBODY if hides else store.viewer):
        yield
