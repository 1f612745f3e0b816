"""The ledger: a file copy of what the database alone knows, written after each transaction."""

from __future__ import annotations

from slamhive.services.ledger.keeping import Ledger
from slamhive.services.ledger.restoring import LedgerRestore

__all__ = [
    "Ledger",
    "LedgerRestore",
]
