"""A plug-in that notes what each test costs: CPU time with that of ended child processes, wall time (s), and its name.

``TESTS_CPU_IN=FOLDER PYTEST_PLUGINS=tests.cpu_times tools/test.py integration``, then ``sort -rn FOLDER/*``.
"""

from __future__ import annotations

import os
import time
from collections.abc import Generator
from pathlib import Path

import pytest

FOLDER = "TESTS_CPU_IN"


def used_s() -> float:
    """CPU time of this process and of the children for which it has waited."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Append a line to the file of this process."""
    cpu_s, began_s = used_s(), time.monotonic()
    result = yield
    folder = Path(os.environ[FOLDER])
    folder.mkdir(exist_ok=True)
    with (folder / f"{os.getpid()}.txt").open("a") as lines:
        lines.write(f"{used_s() - cpu_s:.3f}\t{time.monotonic() - began_s:.3f}\t{item.nodeid}\n")
    return result
