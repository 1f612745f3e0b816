"""The ledger: a file copy of what the database alone knows, written after each transaction."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.base.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.services.ledger.book import LedgerFiles, shared_line
    from slamhive.services.ledger.keeping import Ledger
    from slamhive.services.ledger.restoring import LedgerRestore


if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
