"""Programs of a build: all their words arrive, and nothing of them is left when the build is given up."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable

import psutil
import pytest

from slamhive.executors.build_program import QUIET_S, run_program

pytestmark = pytest.mark.integration


class GivenUp(Exception):
    """Whoever follows the program does not want it any more."""


def run(script: str, on_line: Callable[[str], None]) -> int:
    return run_program([sys.executable, "-u", "-c", script], os.environ, on_line)


def test_lines_and_the_exit_code_arrive() -> None:
    lines: list[str] = []
    script = "import sys; print(' one '); print(); sys.stderr.write('two\\nthr'); print('ee\\xff'); sys.exit(3)"
    assert run(script, lines.append) == 3
    assert sorted(lines) == ["one", "threeÿ", "two"]


def test_a_signal_is_a_negative_exit_code() -> None:
    assert run("import os; os.kill(os.getpid(), 15)", lambda _line: None) == -15


def test_a_program_without_a_line_end_has_its_last_line() -> None:
    lines: list[str] = []
    assert run("print('half', end='')", lines.append) == 0
    assert lines == ["half"]


@pytest.mark.parametrize("says", ["print('begins')", ""], ids=["it said something", "it said nothing"])
def test_a_silent_program_is_ended_with_its_children(says: str) -> None:
    script = f"import subprocess, sys, time; {says}\nsubprocess.run(['sleep', '61.5'])"
    began = time.monotonic()

    def give_up(_line: str) -> None:
        if time.monotonic() - began > QUIET_S:
            raise GivenUp

    with pytest.raises(GivenUp):
        run(script, give_up)
    assert time.monotonic() - began < 4 * QUIET_S + 5
    assert not [found for found in psutil.process_iter(["cmdline"]) if "61.5" in (found.info["cmdline"] or [])]


def test_one_that_ignores_sigterm_is_killed() -> None:
    def give_up(line: str) -> None:
        if line == "ready":
            raise GivenUp

    script = "import signal, time; signal.signal(15, signal.SIG_IGN); print('ready'); time.sleep(61.25)"
    with pytest.raises(GivenUp):
        run(script, give_up)
    assert not [found for found in psutil.process_iter(["cmdline"]) if script in (found.info["cmdline"] or [])]
