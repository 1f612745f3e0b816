"""One calm line for each step of the set-up: what it is, and how long it took."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

LINES_ON_FAILURE = 25


class StepFailed(Exception):
    """A step did not succeed; the message is what the user sees, with the remedy."""


def say(label: str, outcome: str) -> None:
    """Print a finished step."""
    print(f"  {label:<44} {outcome}", flush=True)


def run_step(label: str, command: Sequence[str | Path], environment: dict[str, str] | None = None) -> None:
    """Run ``command`` quietly; on a terminal, show the elapsed seconds.

    Raises StepFailed with the command and the end of its output if it fails.
    """
    started = time.monotonic()
    with tempfile.TemporaryFile("w+") as output:
        try:
            process = subprocess.Popen(
                [str(part) for part in command],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=environment,
            )
        except OSError as error:
            raise StepFailed(f"{label}: {command[0]} cannot be started: {error.strerror}") from None
        _wait(process, label, started)
        if process.returncode == 0:
            say(label, f"{time.monotonic() - started:6.1f} s")
            return
        output.seek(0)
        tail = output.read().strip().splitlines()[-LINES_ON_FAILURE:]
    words = " ".join(str(part) for part in command)
    raise StepFailed("\n".join([f"{label} failed (exit code {process.returncode}): {words}", *tail]))


def _wait(process: subprocess.Popen[bytes], label: str, started: float) -> None:
    ticking = sys.stdout.isatty()
    while True:
        try:
            process.wait(timeout=1.0)
        except subprocess.TimeoutExpired:
            if ticking:
                print(f"  {label:<44} {time.monotonic() - started:6.0f} s", end="\r", flush=True)
        except KeyboardInterrupt:
            process.terminate()
            raise
        else:
            return
