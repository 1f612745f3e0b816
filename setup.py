"""Only what pyproject.toml cannot say: the project folders outside the package go to ``<prefix>/share/slamhive``."""

from __future__ import annotations

from pathlib import Path

from setuptools import setup

FOLDERS = ("algorithms", "datasets", "docker", "docs", "evaluation", "static", "templates")
LEFT_OUT = {"__pycache__", ".venv"}


def data_files() -> list[tuple[str, list[str]]]:
    """One entry for each folder, as setuptools wants it; private certificates stay at home."""
    found: dict[str, list[str]] = {}
    for folder in FOLDERS:
        for path in sorted(Path(folder).rglob("*")):
            if path.is_file() and not LEFT_OUT & set(path.parts) and path.suffix not in {".pyc", ".crt"}:
                found.setdefault(f"share/slamhive/{path.parent.as_posix()}", []).append(path.as_posix())
    return sorted(found.items())


setup(data_files=data_files())
