"""The files by which the worker, the supervisor in a pod and the courier understand each other.

The last two execute this, so it needs no more than Python 3.7 and its standard library.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

POD_FOLDER = "/run/slamhive"
"""Where the supervisor finds its files in the pod."""
WORK_FOLDER = "/run/slamhive-work"
"""Where the courier finds all that belongs to the run, in its own containers."""
COURIER_FOLDER = "/run/slamhive-courier"
"""Where the courier finds its ticket and programs."""
SUPERVISOR_FILE = "supervisor.pyz"
COURIER_FILE = "courier.pyz"
TICKET_FILE = "ticket.json"
NODE_VARIABLE = "SLAMHIVE_NODE"
POD_VARIABLE = "SLAMHIVE_POD"

REFUSED_EXIT = 75
"""The courier has ended for a reason that will be the same the next time."""
OLD_TICKET_EXIT = 76
"""The worker does not know the ticket. A node that was cut off may give a new pod the ticket of the one before."""

ORDER_FILE = "order.json"
CLAIM_FILE = "claimed"
STARTED_FILE = "started.json"
STOP_FILE = "stop"
USAGE_FILE = "usage.json"
LOG_FOLDER = "log"

OWN_FOLDER = "own"
"""Below it are the copies of inputs that the run may change."""
PRIVATE_FOLDER = "courier"
"""What the run does not see."""
READY_FILE = "ready"
DISK_FILE = "disk.json"
OVER_FILE = "over.json"
"""What ``exit.json`` of the pod holds, at the worker before the results are there."""
DELIVERED_FILE = "delivered"
"""The supervisor ends when it sees this, if its order says that it has to wait for it."""


def read_text(path: Path) -> str | None:
    """The content of a small file; None if it cannot be read."""
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return None


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Replace a file in one step."""
    aside = path.with_name("." + path.name)
    aside.write_text(json.dumps(content), encoding="utf-8")
    os.replace(str(aside), str(path))
