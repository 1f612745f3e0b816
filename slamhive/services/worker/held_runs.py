"""The runs that a worker holds."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field


@dataclass
class HeldRuns:
    """Shared between slots and heartbeat; ``cancel`` holds the runs that a user has asked to cancel."""

    lock: threading.Lock = field(default_factory=threading.Lock)
    runs: set[int] = field(default_factory=set)
    cancel: set[int] = field(default_factory=set)

    def add(self, run_id: int) -> None:
        """A slot has claimed the run."""
        with self.lock:
            self.runs.add(run_id)

    def discard(self, run_id: int) -> None:
        """The run has ended or belongs to another worker now."""
        with self.lock:
            self.runs.discard(run_id)
            self.cancel.discard(run_id)

    def snapshot(self) -> set[int]:
        """The runs held now."""
        with self.lock:
            return set(self.runs)
