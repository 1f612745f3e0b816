"""The courier of a pod as a process, started from what the Secret of the pod holds."""

from __future__ import annotations

import base64
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

_SCRIPT = """\
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[1] + "/courier.pyz")
from slamhive.executors.kubernetes import courier
programs, folders = Path(sys.argv[1]), courier.PodFolders(Path(sys.argv[2]))
ticket = courier.Ticket.loads((programs / "ticket.json").read_text())
courier.fetch(ticket, programs, folders)
courier.CourierReport(ticket, folders).run()
"""


def start_courier(
    secret: Mapping[str, str], programs: Path, pod: Path, node: str = "node1", uid: str = "uid1"
) -> subprocess.Popen[bytes]:
    """Bring the data of a run to the folder ``pod`` and report from there, with the programs of the Secret alone."""
    programs.mkdir()
    for name, content in secret.items():
        (programs / name).write_bytes(base64.b64decode(content))
    command = [sys.executable, "-I", "-c", _SCRIPT, str(programs), str(pod)]
    return subprocess.Popen(command, env={**os.environ, "SLAMHIVE_NODE": node, "SLAMHIVE_POD": uid})
