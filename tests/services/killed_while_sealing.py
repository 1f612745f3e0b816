"""A worker on a busy machine that kills itself (SIGKILL) as it seals the first disturbed run.

Run as ``python -m tests.services.killed_while_sealing WHEN``: ``inside`` the transaction that ends the run, ``after``
it, or ``never``.
"""

from __future__ import annotations

import os
import signal
import sys
from typing import Any

from slamhive.services.hive import open_hive
from slamhive.services.runs.service import repeat_if_disturbed
from slamhive.services.worker import collecting
from slamhive.store import Store
from tests.services.disturbed_machine import BUSY, beside


def die() -> None:
    """As the kernel kills a process that took too much memory."""
    os.kill(os.getpid(), signal.SIGKILL)


def main(when: str) -> None:
    """Work until nothing is left, or until the chosen moment."""
    sealing = []
    write = Store.write

    def repeat(*arguments: Any) -> None:
        repeat_if_disturbed(*arguments)
        sealing.append(True)
        if when == "inside":
            die()

    def write_and_die(self: Store, work: Any) -> Any:
        result = write(self, work)
        if when == "after" and sealing:
            die()
        return result

    vars(collecting)["repeat_if_disturbed"] = repeat
    Store.write = write_and_die  # type: ignore[method-assign]
    hive = open_hive()
    hive.executors.opened["process"] = beside(*BUSY)
    hive.worker().run(until_idle=True)


if __name__ == "__main__":
    main(sys.argv[1])
