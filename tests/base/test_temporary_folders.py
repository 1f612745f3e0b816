"""Folders that a process works in are its own from the first moment, also while another process sweeps."""

from __future__ import annotations

import tempfile
import threading
from pathlib import Path

import pytest

from slamhive.base.files import sweep_temporary, temporary_folder

pytestmark = pytest.mark.quick


@pytest.mark.integration
def test_a_new_temporary_folder_is_never_swept(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    done = threading.Event()

    def sweep() -> None:
        while not done.is_set():
            sweep_temporary()

    sweepers = [threading.Thread(target=sweep) for _ in range(2)]
    for sweeper in sweepers:
        sweeper.start()
    try:
        for number in range(150):
            with temporary_folder() as folder:
                (folder / "file").write_text(str(number))
                assert (folder / "file").read_text() == str(number)
    finally:
        done.set()
        for sweeper in sweepers:
            sweeper.join()
    assert not list(tmp_path.iterdir())
