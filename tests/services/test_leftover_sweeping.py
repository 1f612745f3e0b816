"""What a killed process has left is removed by the worker that starts next; what a live one works on stays."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from slamhive.documents.submission import Submission
from slamhive.services.hive import Hive
from slamhive.services.worker.leftovers import sweep_leftovers
from slamhive.store import Lease

pytestmark = pytest.mark.integration

HOLDING = """
import sys, tempfile, time
from pathlib import Path
from slamhive.base import files
from slamhive.recordings.staging import new_dataset_folder
from slamhive.executors.process.environment import Environments
from slamhive.services.evaluations.service import scratch_folder

data = Path(sys.argv[1])
run = data / "runs" / "1"
(run / "evaluations" / "abc").mkdir(parents=True)
descriptor, name = tempfile.mkstemp(dir=run, prefix=".run.json.")
other, _ = tempfile.mkstemp(dir=run / "evaluations" / "abc", prefix=".result.json.")
for held in (descriptor, other):
    files.fcntl.flock(held, files.fcntl.LOCK_EX)
(data / "environments" / "half-123").mkdir(parents=True)
(data / "analyses").mkdir()
with (
    scratch_folder(data),
    files.temporary_folder(),
    new_dataset_folder(data / "datasets" / "half", 0),
    files.held_folder(data / "analyses" / ".token"),
    Environments(data)._locked("half-123"),
):
    print("holds", flush=True)
    time.sleep(600)
"""


@pytest.fixture
def holding(hive: Hive, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """A process in the middle of everything that leaves something when it is killed."""
    (tmp_path / "temporary").mkdir()
    (hive.settings.data / "environments").unlink()  # others share it, and may sweep it
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    monkeypatch.setattr(tempfile, "tempdir", None)
    hive.runs.submit(Submission("tiny", "track"))
    hive.runs.submit(Submission("tiny", "track"))
    hive.store.write(lambda t: t.queue.claim(Lease("nobody", hive.runs.get(1).created_at, 1.0), [1]))
    command = [sys.executable, "-c", HOLDING, str(hive.settings.data)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=dict(os.environ)) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "holds\n"
        yield process
        process.kill()


def test_only_what_nobody_works_on_goes(hive: Hive, holding: subprocess.Popen[str], tmp_path: Path) -> None:
    begun = left(hive, tmp_path)
    assert len(begun) == 7
    sweep(hive)
    assert left(hive, tmp_path) == begun, "a live process works on all of it"
    holding.send_signal(signal.SIGKILL)
    holding.wait()
    sweep(hive)
    assert left(hive, tmp_path) == []


def sweep(hive: Hive) -> None:
    sweep_leftovers(hive.settings, hive.store, hive.variants, hive.executors.get)
    hive.executors.get("process").sweep(list)


def left(hive: Hive, tmp_path: Path) -> list[str]:
    """All that is half made, by name."""
    data = hive.settings.data
    places = (data, data / "datasets", data / "analyses", *(data / "runs" / "1").rglob("."), tmp_path / "temporary")
    hidden = [entry for place in places for entry in place.glob(".*") if not entry.name.endswith(".lock")]
    return sorted(str(entry) for entry in (*hidden, *(data / "environments").glob("half-*")))
