"""The files of the ledger."""

from __future__ import annotations

from pathlib import Path

from slamhive.services.ledger.book import Book


class LedgerFiles:
    """``<data>/ledger/``.

    Args:
        folder: The folder, created with its first line.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @property
    def configurations(self) -> Book:
        """Configurations with their numbers, labels, and deletions."""
        return Book(self.folder / "configurations.jsonl")

    @property
    def runs(self) -> Book:
        """Queued runs, and cancellations."""
        return Book(self.folder / "runs.jsonl")

    @property
    def cells(self) -> Book:
        """Cells of experiments, and the number of cells and runs of each."""
        return Book(self.folder / "cells.jsonl")

    @property
    def evaluations(self) -> Book:
        """Requested evaluations, and how they ended."""
        return Book(self.folder / "evaluations.jsonl")

    @property
    def catalogue(self) -> Book:
        """Algorithms with their versions, and datasets; a small file that is always replaced."""
        return Book(self.folder / "catalogue.jsonl")

    @property
    def searches(self) -> Book:
        """Saved searches; a small file that is always replaced."""
        return Book(self.folder / "searches.jsonl")
