"""An import that kills itself (SIGKILL) at its N-th step: before or after a write to the database or to the disk.

Run as ``python killed_import.py SOURCE N``; exit by signal 9 means that step N was reached, exit 0 that the work was
done before.
"""

from __future__ import annotations

import sys
from pathlib import Path

from slamhive.domain.sensors import SensorSetup
from slamhive.runs.folder import RunFolder
from slamhive.services.hive import open_hive
from slamhive.services.imports.request import ImportRequest
from slamhive.store import Store
from tests.services.killed_worker import Countdown


def main(source: Path, fatal_step: int) -> None:
    """Import, until all is done or until the chosen step."""
    countdown = Countdown(fatal_step)
    hive = open_hive()
    for owner, names in ((Store, ("write",)), (RunFolder, ("create", "write_record")), (Path, ("rename",))):
        for name in names:
            setattr(owner, name, countdown.around(getattr(owner, name)))
    request = ImportRequest(source, sensors={"": SensorSetup.STEREO})
    hive.imports.carry_out(request, lambda _done, _total: None)
    sys.stdout.write(f"steps {countdown.step}\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
