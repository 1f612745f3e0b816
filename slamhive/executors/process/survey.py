"""Trial of the protections of this machine, for ``slamhive doctor``. Nothing on the machine is changed.

A control group is tried out where one can be made and removed again. That is so under version 1, in a home that is
settled, and in a scope that systemd makes for the trial. Before the first run of a delegated unit, its files foretell
the group.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import slamhive
from slamhive.executors.process import priority
from slamhive.executors.process.cgroup_home import OWN_SCOPE, find_home, run_in_scope, scope_wanted
from slamhive.executors.process.containment import choose_containment
from slamhive.executors.process.containment_base import Containment, ContainmentRequest, DoesNotHold
from slamhive.executors.process.run_cgroup import RunCgroup
from slamhive.executors.process.table import read_process
from slamhive.executors.status import Protections

_ANY_TASKS = 16
_FORESEEN = ", foreseen from the files of the group"


def survey(installation: str, kind: str | None = None) -> Protections:
    """Describe the containment that a run would get now.

    Raises DoesNotHold as :func:`choose_containment`.
    """
    request = ContainmentRequest(installation, f"survey-{os.getpid()}", _ANY_TASKS)
    if kind not in (None, RunCgroup.kind):
        return _tried(request, kind)
    if scope_wanted():
        # Another process looks from within a scope of its own, as a supervisor would.
        environment = {**os.environ, "PYTHONPATH": str(Path(slamhive.__file__).parent.parent)}
        with tempfile.TemporaryFile() as output:
            command = [sys.executable, "-m", __name__, installation, kind or ""]
            refused = run_in_scope(command, environment, output.fileno())
            if refused is not None:
                return _tried(replace(request, no_scope=refused), kind)
            output.seek(0)
            return Protections(**json.loads(output.read().splitlines()[-1]))
    try:
        home = find_home()
    except DoesNotHold:
        return _tried(request, kind)
    if home.settled:
        return _tried(request, kind)
    group = RunCgroup.foreseen(request, home)
    told = _described(group, {})
    return replace(told, held_by=told.held_by + _FORESEEN)


def _tried(request: ContainmentRequest, kind: str | None) -> Protections:
    """Make the containment, describe it, and remove it."""
    chosen = choose_containment(request, kind)
    try:
        return _described(chosen.containment, chosen.does_not_hold)
    finally:
        chosen.containment.remove()


def _described(containment: Containment, does_not_hold: dict[str, str]) -> Protections:
    # A process that ends at once tries the priority that a supervisor would get.
    shares = [] if containment.holds_cpu else ["shares"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-m", priority.__name__, *shares]
    said = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, env=environment).stdout.strip()
    return Protections(**containment.words(), priority=said, does_not_hold=does_not_hold)


def survey_goes_on(group: str) -> bool:
    """Return whether the control group ``group`` is that of a survey which another process makes now."""
    pid = group.rpartition("-survey-")[2]
    return pid.isdigit() and read_process(int(pid)) is not None


def main(arguments: Sequence[str]) -> None:
    """Print the survey of this process as JSON: ``INSTALLATION KIND --own-scope``."""
    installation, kind, *rest = arguments
    request = ContainmentRequest(installation, f"survey-{os.getpid()}", _ANY_TASKS, own_scope=OWN_SCOPE in rest)
    sys.stdout.write(json.dumps(asdict(_tried(request, kind or None))) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
