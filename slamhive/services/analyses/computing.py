"""A process that computes an analysis or its previews, with limited resources."""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import slamhive
from slamhive.errors import Conflict
from slamhive.settings import SETTINGS, Settings

logger = logging.getLogger(__name__)

CHILD = "slamhive.services.analysis_process"
MOST_SAID_BYTES = 100_000
_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


class Computing:
    """The process that is computing, and what it writes."""

    def __init__(self, child: subprocess.Popen[bytes], output: IO[bytes], errors: IO[bytes]) -> None:
        self._child = child
        self._output = output
        self._errors = errors

    @property
    def goes_on(self) -> bool:
        """Whether it has not ended."""
        return self._child.poll() is None

    def said(self) -> dict[str, Any]:
        """What it reported at its end, or ``error`` with the reason why it reported nothing."""
        return _said(self._child.returncode, _tail(self._output), _tail(self._errors))


@contextmanager
def computing(settings: Settings, project_root: Path, folder: Path, **asked: Any) -> Iterator[Computing]:
    """Start the process on a folder with an analysis file, and end it at the end of the block.

    It ends with this process, too. ``asked`` goes to it beside the settings and limits, or in place of them.
    """
    package = Path(slamhive.__file__).parent.parent
    paths = os.pathsep.join(filter(None, (str(package), os.environ.get("PYTHONPATH"))))
    environment = {**os.environ, **dict.fromkeys(_THREADS, "1"), "PYTHONPATH": paths, "MPLBACKEND": "agg"}
    with tempfile.TemporaryFile() as output, tempfile.TemporaryFile() as errors:
        child = subprocess.Popen(
            [sys.executable, "-m", CHILD, str(folder)],
            stdin=subprocess.PIPE, stdout=output, stderr=errors, env=environment, start_new_session=True,
        )  # fmt: skip
        assert child.stdin is not None
        try:
            child.stdin.write(json.dumps(_asked(settings, project_root) | asked, default=str).encode() + b"\n")
            child.stdin.flush()
            yield Computing(child, output, errors)
        except BrokenPipeError:
            raise Conflict("the process that computes analyses ends at once", "see the log of the worker") from None
        finally:
            child.kill()
            child.wait()
            child.stdin.close()


def _asked(settings: Settings, project_root: Path) -> dict[str, Any]:
    return {
        "settings": {name: getattr(settings, name) for name in SETTINGS},
        "project_root": str(project_root),
        "version": slamhive.__version__,
        "memory_bytes": settings.analysis_memory_mb * 1_000_000,
        "time_limit_s": settings.analysis_time_limit_s,
    }


def _said(code: int, output: str, errors: str) -> dict[str, Any]:
    try:
        said = json.loads(output.strip().rpartition("\n")[2])
        if code in (0, 1) and isinstance(said, dict):
            return said
    except ValueError:
        pass
    if "MemoryError" in errors or "cannot allocate" in errors.lower():
        return {"error": "the analysis needs more memory than ANALYSIS_MEMORY_MB; select fewer runs"}
    logger.error("the process that computes an analysis ended with %d: %s", code, errors[-5000:])
    ended = f"by signal {-code}" if code < 0 else f"with {code}"
    return {"error": f"the process that computed it ended {ended}; see the log of the worker"}


def _tail(stream: IO[bytes]) -> str:
    stream.seek(0, os.SEEK_END)
    stream.seek(max(0, stream.tell() - MOST_SAID_BYTES))
    return stream.read().decode(errors="replace")
