"""Tries out how limits are enforced on this machine, for ``slamhive doctor``."""

from __future__ import annotations

import os
import subprocess
import sys

from slamhive.executors.process import priority
from slamhive.executors.process.containment import choose_containment
from slamhive.executors.process.containment_base import ContainmentRequest
from slamhive.executors.process.table import read_process
from slamhive.executors.status import Protections

_ANY_TASKS = 16


def survey(installation: str, kind: str | None = None) -> Protections:
    """Make the containment that a run would get now, describe it, and remove it.

    Raises DoesNotHold as :func:`choose_containment`.
    """
    chosen = choose_containment(ContainmentRequest(installation, f"survey-{os.getpid()}", _ANY_TASKS), kind)
    try:
        words = chosen.containment.words()
        shares_processors = not chosen.containment.holds_cpu
        return Protections(
            **words, priority=_priority_here(shares_processors=shares_processors), does_not_hold=chosen.does_not_hold
        )
    finally:
        chosen.containment.remove()


def survey_goes_on(group: str) -> bool:
    """Whether the control group ``group`` is that of a survey which another process makes now."""
    pid = group.rpartition("-survey-")[2]
    return pid.isdigit() and read_process(int(pid)) is not None


def _priority_here(*, shares_processors: bool) -> str:
    """The priority that a supervisor would get, in words. A process that ends at once tries it."""
    command = [sys.executable, "-m", priority.__name__, *(["shares"] if shares_processors else [])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    return subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, env=environment).stdout.strip()
