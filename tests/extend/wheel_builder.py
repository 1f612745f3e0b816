"""Builds wheels in processes that are forked from one that has imported the build backend.

Run as a program, it builds one package for each line: its folder and that of the wheel, as JSON.
"""

from __future__ import annotations

import importlib
import json
import os
import tomllib
from collections.abc import Sequence
from pathlib import Path

from tests.forking import forked, serve


def build_wheels(packages: Sequence[Path], folder: Path) -> list[Path]:
    """The wheels of ``packages`` below ``folder``, each made by the backend that its pyproject.toml names.

    pip starts three interpreters for each package, which takes ten times as long.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with forked("-m", "tests.extend.wheel_builder") as build:
        for package in packages:
            ended = build(json.dumps([str(package), str(folder)]))
            assert ended.returncode == 0, ended.errors
    return sorted(folder.glob("*.whl"))


def build_wheel(line: str) -> int:
    """Build the package that the line names."""
    package, folder = json.loads(line)
    os.dup2(2, 1)  # standard output is for answers, and backends print
    os.chdir(package)
    project = tomllib.loads(Path("pyproject.toml").read_text())
    backend = importlib.import_module(project["build-system"]["build-backend"])
    backend.build_wheel(folder)
    return 0


if __name__ == "__main__":
    serve(build_wheel)
