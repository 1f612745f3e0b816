"""Computes one analysis and kills itself (SIGKILL) as soon as its process of computation runs."""

from __future__ import annotations

import os
import signal
import sys
import threading
from pathlib import Path

from slamhive.executors.host import worker_identity
from slamhive.services.hive import open_hive
from slamhive.services.stored_analyses.computing import AnalysisJobs


def main() -> None:
    """End by signal 9, with the process left behind."""

    def die(self: AnalysisJobs, record: object, owner: str) -> None:
        children = Path(f"/proc/self/task/{os.getpid()}/children").read_text()
        sys.stdout.write(children.split()[0])
        sys.stdout.flush()
        os.kill(os.getpid(), signal.SIGKILL)

    AnalysisJobs._beat = die  # type: ignore[method-assign]
    open_hive().analysis_jobs.work_once(worker_identity(), threading.Event())


if __name__ == "__main__":
    main()
