"""A real disturbance: processes that keep the cores busy, for a test's time only."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

_LONGEST_S = 300
_BURN = f"""
import time
print("burning", flush=True)
end_s = time.monotonic() + {_LONGEST_S}
while time.monotonic() < end_s:
    pass
"""


@contextmanager
def busy_machine(per_core: float = 2) -> Iterator[None]:
    """So many busy processes for each core; they run when the block begins, and end with it or after five minutes."""
    count = math.ceil(per_core * (os.cpu_count() or 1))
    burners = [subprocess.Popen([sys.executable, "-c", _BURN], stdout=subprocess.PIPE) for _ in range(count)]
    try:
        for burner in burners:
            assert burner.stdout is not None
            burner.stdout.readline()
        yield
    finally:
        for burner in burners:
            burner.kill()
            burner.communicate()
