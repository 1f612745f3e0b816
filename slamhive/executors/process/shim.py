"""The supervisor of one algorithm process: ``python -m slamhive.executors.process.shim <work folder>``.

It outlives the worker that started it, so that a restarted worker finds out how the algorithm ended. They communicate
by files in the work folder:

- ``shim-spec.json``: the orders.
- ``shim.lock``: locked while the supervisor is alive.
- ``shim.json``: which process it is, and since when.
- ``output/``: what the algorithm prints, capped.
- ``exit.json``: how it ended. Its disk space is reserved before the start, since an algorithm may fill the disk.
- ``shim-errors.txt``: why the supervisor did not start. The worker has reserved its space.

The supervisor is the "subreaper" of all descendants of the algorithm. None can escape by forking twice or by opening
a session, and the CPU time of each counts when it is reaped.

Signals: SIGTERM is passed on to all descendants, SIGUSR1 kills them.
"""

from __future__ import annotations

import fcntl
import json
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from slamhive.base.clock import utc_now
from slamhive.base.errors import Unavailable
from slamhive.base.files import is_full, write_aside
from slamhive.executors.process.cgroup_home import NO_SCOPE, OWN_SCOPE
from slamhive.executors.process.containment_base import DoesNotHold
from slamhive.executors.process.exit_file import reserve
from slamhive.executors.process.shim_spec import ShimSpec
from slamhive.executors.process.supervisor import Supervisor

LOCK_FILE = "shim.lock"
IDENTITY_FILE = "shim.json"
NO_ROOM = "no room: "
"""The last line of a supervisor that did not start because the disk is full begins so."""


def main(arguments: Sequence[str]) -> None:
    """Supervise the run of a work folder, unless another shim does or did.

    The calling process ends at once. A child in a session of its own does the work, so that neither the end of the
    worker nor that of its terminal reaches it.

    Args:
        arguments: The work folder, then ``--own-scope`` if systemd made a scope for this process, or ``--no-scope`` and
            the reason if it did not.
    """
    work = Path(arguments[0])
    own_scope = OWN_SCOPE in arguments[1:2]
    no_scope = arguments[2] if NO_SCOPE in arguments[1:2] else ""
    if os.fork() > 0:
        os._exit(0)
    os.setsid()
    try:
        supervise(work, own_scope=own_scope, no_scope=no_scope)
    except (Unavailable, OSError) as error:
        if (work / IDENTITY_FILE).exists() or not is_full(error):
            raise
        sys.exit(f"{NO_ROOM}{error}")


def supervise(
    work: Path, prepare: Callable[[Path], None] | None = None, *, own_scope: bool = False, no_scope: str = ""
) -> None:
    """Supervise the run of this work folder in the calling process, unless another supervisor does or did.

    ``prepare`` may complete the orders first. The others are arguments of :class:`Supervisor`.
    """
    descriptor = os.open(work / LOCK_FILE, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return  # another supervisor is at work; the kernel releases its lock when it ends, in whatever way
    if (work / IDENTITY_FILE).exists():
        return  # another one has been here and has ended: a run is executed once
    if prepare is not None:
        prepare(work)
    try:
        supervisor = Supervisor(work, ShimSpec.load(work), own_scope=own_scope, no_scope=no_scope)
    except DoesNotHold as reason:
        sys.exit(str(reason))
    supervisor.listen()
    started_at = utc_now()
    reserve(work)  # before the run is there: its disk may be full when it ends
    write_aside(work / IDENTITY_FILE, json.dumps(supervisor.introduction(started_at)))
    supervisor.run(started_at)


if __name__ == "__main__":
    main(sys.argv[1:])
