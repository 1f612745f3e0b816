"""An import that kills itself (SIGKILL) at its N-th step: before or after a write to the database or to the disk.

Run as ``python killed_import.py SOURCE``; it answers each line with an N as :mod:`tests.services.killed_worker` does.
"""

from __future__ import annotations

import sys
from pathlib import Path

from slamhive.domain.sensors import SensorSetup
from slamhive.run_folder.folder import RunFolder
from slamhive.services.hive import open_hive
from slamhive.services.imports.request import ImportRequest
from slamhive.store import Store
from tests.forking import serve
from tests.services.killed_worker import Countdown


def import_source(source: Path, fatal_step: int) -> int:
    """Import, until all is done or until the chosen step; how many steps that took."""
    countdown = Countdown(fatal_step)
    hive = open_hive()
    for owner, names in ((Store, ("write",)), (RunFolder, ("create", "write_record")), (Path, ("rename",))):
        for name in names:
            setattr(owner, name, countdown.around(getattr(owner, name)))
    hive.imports.carry_out(ImportRequest(source, sensors={"": SensorSetup.STEREO}), lambda _done, _total: None)
    hive.close()
    return countdown.step


if __name__ == "__main__":
    serve(lambda line: import_source(Path(sys.argv[1]), int(line)))
