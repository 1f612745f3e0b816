"""Where the books of the ledger lie."""

from __future__ import annotations

from pathlib import Path

from slamhive.services.ledger.book import Book


class LedgerFiles:
    """``<data>/ledger/``.

    Args:
        folder: Where it lies; it is made with its first line.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @property
    def configurations(self) -> Book:
        """Configurations with their numbers, what users say about them, and those that were deleted."""
        return Book(self.folder / "configurations.jsonl")

    @property
    def runs(self) -> Book:
        """Runs as they were queued, and those that were cancelled."""
        return Book(self.folder / "runs.jsonl")

    @property
    def cells(self) -> Book:
        """Cells of experiments, and how many cells and runs each has."""
        return Book(self.folder / "cells.jsonl")

    @property
    def evaluations(self) -> Book:
        """Evaluations that were asked for, and how they ended."""
        return Book(self.folder / "evaluations.jsonl")

    @property
    def catalogue(self) -> Book:
        """Algorithms with their versions, and datasets; a small book that is always replaced."""
        return Book(self.folder / "catalogue.jsonl")

    @property
    def searches(self) -> Book:
        """Saved searches; a small book that is always replaced."""
        return Book(self.folder / "searches.jsonl")
