"""A scope of its own for a supervisor, where systemd manages this process in a unit that it has not delegated.

That is the case in an ssh session, on a desktop, and in a service without ``Delegate=yes``. The manager of this user,
or that of the machine for root, makes the scope, and the supervisor makes the group of its run in there. The worker
stays where it is. The scope ends with its last process.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path

from slamhive.executors.cgroup import CGROUP_ROOT
from slamhive.executors.process.cgroup_home import find_home, manager_of_user
from slamhive.executors.process.containment_base import DoesNotHold

OWN_SCOPE = "--own-scope"
NO_SCOPE = "--no-scope"
"""Arguments of programs that are started by :func:`run_in_scope`."""
_RUNNING_SYSTEMD = Path("/run/systemd/system")
_ANSWER_S = 30.0


def scope_wanted(root: Path = CGROUP_ROOT, systemd: Path = _RUNNING_SYSTEMD) -> bool:
    """Return whether only systemd can give this process a group to make others in. Only looks.

    Args:
        root: Where the control groups are mounted. Version 1 is used without systemd's help.
        systemd: The folder that is there if systemd runs this machine.
    """
    if not systemd.is_dir() or not (root / "cgroup.controllers").exists():
        return False
    try:
        find_home(root)
    except DoesNotHold:
        return True
    return False


def run_in_scope(command: Sequence[str], environment: Mapping[str, str], output: int) -> str | None:
    """Run ``command`` in a scope, with the argument ``--own-scope``; why that failed, or None.

    Args:
        command: A program that forks, or ends soon.
        environment: Its variables. Those that lead to the user's manager are added.
        output: The file descriptor for what it prints.
    """
    program = shutil.which("systemd-run")
    if program is None:
        return "systemd-run is missing"
    manager, variables = manager_of_user(os.geteuid(), os.environ)
    arguments = ["--scope", "--quiet", "--collect", "--property=Delegate=yes", "--description=SLAM Hive run", "--"]
    words = [program, *manager, *arguments, *command, OWN_SCOPE]
    start = os.lseek(output, 0, os.SEEK_CUR)
    try:
        ended = subprocess.run(
            words,
            env={**environment, **variables},
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            cwd="/",
            check=False,
            timeout=_ANSWER_S,
        )
    except subprocess.TimeoutExpired:
        return f"systemd-run did not answer within {_ANSWER_S:.0f} s"
    if ended.returncode == 0:
        return None
    said = os.pread(output, os.lseek(output, 0, os.SEEK_CUR) - start, start).decode(errors="replace").strip()
    return said.splitlines()[-1] if said else f"systemd-run ended with {ended.returncode}"
