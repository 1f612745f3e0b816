"""Waiting for what happens soon on an idle machine and some time later on a busy one."""

from __future__ import annotations

import time
from collections.abc import Callable

PATIENCE_S = 90.0
"""Long enough for a machine on which ten things happen at once; nobody waits that long unless something is broken."""

_STEP_S = 0.02


def eventually(condition: Callable[[], object], what: str = "it", patience_s: float = PATIENCE_S) -> None:
    """Return once ``condition`` holds; the test fails, naming ``what`` did not happen, after ``patience_s``."""
    deadline_s = time.monotonic() + patience_s
    while not condition():
        assert time.monotonic() < deadline_s, f"{what} did not happen within {patience_s:.0f} s"
        time.sleep(_STEP_S)
