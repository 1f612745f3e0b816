"""Decides when to end a run that is refused processes. Pure, and the same for containers and processes.

A run that reaches its limit of processes for a moment may go on. One that still asks for more seconds later is a fork
bomb, or lacks so much that its result would mean nothing.
"""

from __future__ import annotations

REFUSAL_PATIENCE_S = 3.0
"""A run is ended after refusals for this long, unless there were none for the same time in between."""


class RefusalWatch:
    """Collects refusals, and says when the run must end.

    Args:
        patience_s: For how long refusals are tolerated; 0 ends the run at the first.
    """

    def __init__(self, patience_s: float = REFUSAL_PATIENCE_S) -> None:
        self._patience_s = patience_s
        self._first_s: float | None = None
        self._last_s = 0.0
        self.refused = False
        """Whether the run was ever refused a process."""

    def see(self, *, refused: bool, now_s: float) -> bool:
        """Add one look at the run; whether it is to be ended now.

        Args:
            refused: Whether it was refused a process since the last look, or is still at the limit that refused it.
            now_s: Monotonic time of the look.
        """
        if not refused:
            return False
        self.refused = True
        if self._first_s is None or now_s - self._last_s > self._patience_s:
            self._first_s = now_s
        self._last_s = now_s
        return now_s - self._first_s >= self._patience_s
