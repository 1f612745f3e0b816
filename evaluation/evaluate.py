"""Evaluate the runs listed in a job file: ``evaluate.py job.json``; one JSON line on stdout per finished run.

Runs in the evaluation container and in a plain process alike.
"""

import gc
import os
import sys
import tempfile
from pathlib import Path


def _prepare_environment() -> None:
    """Before anything is imported: one thread per worker, no display, and a home that evo may write into."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ["MPLBACKEND"] = "Agg"
    os.environ.pop("DISPLAY", None)
    os.environ["HOME"] = os.environ["MPLCONFIGDIR"] = tempfile.mkdtemp(prefix="evaluation-home-")
    # What imports make stays: looking for garbage in it takes a sixth of their time.
    gc.set_threshold(100_000, *gc.get_threshold()[1:])


def _emit(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main() -> int:
    """Run the job given on the command line; returns the exit code."""
    _prepare_environment()
    sys.path.append(str(Path(__file__).resolve().parent.parent))
    from slamhive.evaluation import work  # noqa: PLC0415  (after the environment is prepared)

    return work.main(sys.argv[1:], _emit)


if __name__ == "__main__":
    sys.exit(main())
