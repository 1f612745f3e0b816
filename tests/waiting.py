"""Waiting for what happens soon on an idle machine and some time later on a busy one."""

from __future__ import annotations

import time
from collections.abc import Callable

PATIENCE_S = 90.0
"""Long enough for a machine on which ten things happen at once; nobody waits that long unless something is broken."""

_STEP_S = 0.02
_SHARE = 4
_LONGEST_STEP_S = 0.2


def eventually(condition: Callable[[], object], what: str = "it", patience_s: float = PATIENCE_S) -> None:
    """Return once ``condition`` holds; the test fails, naming ``what`` did not happen, after ``patience_s``.

    It looks 50 times a second where a look is cheap. A question to a database is not: looking all the time would take
    half a core from what is waited for.
    """
    deadline_s = time.monotonic() + patience_s
    while True:
        began_s = time.monotonic()
        if condition():
            return
        now_s = time.monotonic()
        assert now_s < deadline_s, f"{what} did not happen within {patience_s:.0f} s"
        time.sleep(min(_LONGEST_STEP_S, max(_STEP_S, _SHARE * (now_s - began_s))))
