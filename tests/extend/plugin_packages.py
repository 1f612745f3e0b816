"""Real packages with entry points, installed into folders of their own that tested processes see."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

CHECKOUT = Path(__file__).resolve().parents[2]
EXTEND = CHECKOUT / "docs" / "extend"
_SECTION = re.compile(r"^## .*?(?=^## |\Z)", re.MULTILINE | re.DOTALL)
_TOML = re.compile(r"```toml\n(.*?)```", re.DOTALL)
_LINK = re.compile(r"\]\((\w+)(\.py|/[\w.]+)\)")
_MODULE = re.compile(r'= "(slamhive_\w+)[":]')

HEAD = """
[build-system]
requires = ["setuptools>=77"]
build-backend = "setuptools.build_meta"

[project]
name = "{name}"
version = "1.0.0"
"""


def write_package(folder: Path, module: str, code: str, tables: str) -> Path:
    """A package of one module; ``tables`` are those of its pyproject.toml besides the name."""
    folder.mkdir(parents=True)
    modules = "" if "[tool.setuptools]" in tables else f'\n[tool.setuptools]\npy-modules = ["{module}"]\n'
    name = module.replace("_", "-")
    (folder / "pyproject.toml").write_text(f"{HEAD.format(name=name)}{modules}{tables}")
    (folder / f"{module}.py").write_text(code)
    return folder


def write_examples(folder: Path) -> list[Path]:
    """Every example of docs/extend with the entry points that its section of the page shows."""
    written = []
    for section in _SECTION.findall((EXTEND / "index.md").read_text()):
        found = _TOML.search(section)
        if found is None:
            continue
        source, kind = _LINK.findall(section)[0]
        module = _MODULE.findall(found[1])[0]
        if kind == ".py":
            package = write_package(folder / module, module, (EXTEND / f"{source}.py").read_text(), found[1])
        else:
            package = folder / module
            package.mkdir(parents=True)
            shutil.copytree(EXTEND / source, package / module)
            head = HEAD.format(name=module.replace("_", "-"))
            (package / "pyproject.toml").write_text(f"{head}\n{found[1]}")
        written.append(package)
    return written


def install(packages: list[Path], target: Path) -> Path:
    """Install packages into the folder ``target``."""
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation"]
    command += ["--disable-pip-version-check", "--target", str(target), *map(str, packages)]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    return target


class Command:
    """``slamhive`` in a process of its own.

    Args:
        root: The project folder.
        data: The data root.
        plugins: The folder of installed plug-ins; None for none.
    """

    def __init__(self, root: Path, data: Path, plugins: Path | None, **settings: str) -> None:
        paths = [str(CHECKOUT), *([] if plugins is None else [str(plugins)])]
        own = {f"SLAMHIVE_{key.upper()}": value for key, value in settings.items()}
        self.environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(paths),
            "SLAMHIVE_ROOT": str(root),
            "SLAMHIVE_DATA": str(data),
            "SLAMHIVE_EXECUTOR": "process",
            "SLAMHIVE_MIN_FREE_DISK_MB": "1",
            **own,
        }

    def run(self, *arguments: str, expected: int = 0) -> subprocess.CompletedProcess[str]:
        """Run one command to its end; it must end with the exit code ``expected``."""
        command = [sys.executable, "-m", "slamhive", *arguments]
        ended = subprocess.run(command, env=self.environment, cwd=CHECKOUT, capture_output=True, text=True, check=False)
        assert ended.returncode == expected, ended.stdout + ended.stderr
        return ended

    def json(self, *arguments: str, expected: int = 0) -> Any:
        """What a command prints with ``--json``."""
        return json.loads(self.run(*arguments, "--json", expected=expected).stdout)
