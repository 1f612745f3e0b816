"""When a run that is refused more processes is ended. Pure, and the same for containers and processes.

A run that touches its limit of processes for a moment may go on: it was refused some and got along without them. One
that still asks for more seconds later is either a fork bomb or so crippled that its result would say nothing.
"""

from __future__ import annotations

REFUSAL_PATIENCE_S = 3.0
"""A run is ended when it has been refused processes for this long, without a calm of the same length in between."""


class RefusalWatch:
    """Collects whether the run is being refused processes, and says when it is to be ended.

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
