"""Small real inputs in ``../shared/cases``, one folder each, whose README says what is right."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

CASES = Path(__file__).resolve().parents[2] / "shared" / "cases"


def case(name: str, folder: Path | None = None) -> Path:
    """The folder of a case, or a copy at ``folder`` that can be changed; skips the test where it is not here."""
    found = CASES / name
    if not found.is_dir():
        pytest.skip(f"../shared/cases/{name} is not here")
    if folder is None:
        return found
    shutil.copytree(found, folder)
    for path in (folder, *folder.rglob("*")):
        path.chmod(0o755 if path.is_dir() else 0o644)
    return folder
