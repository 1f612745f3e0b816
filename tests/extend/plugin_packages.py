"""Real packages with entry points, installed into folders of their own that tested processes see."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
import zipfile
from pathlib import Path
from typing import Any

from tests.extend.wheel_builder import build_wheels
from tests.forked_commands import Run
from tests.sharing import share_environments

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


def write_wheel(folder: Path, module: str, code: str, tables: str) -> Path:
    """The package that :func:`write_package` writes, built: pip needs a second for each that it builds."""
    folder.mkdir(parents=True, exist_ok=True)
    groups = tomllib.loads(tables)["project"]["entry-points"].items()
    points = "".join(
        f"[{group}]\n" + "".join(f"{name} = {value}\n" for name, value in entries.items()) for group, entries in groups
    )
    info = f"{module}-1.0.0.dist-info"
    files = {
        f"{module}.py": code,
        f"{info}/METADATA": f"Metadata-Version: 2.1\nName: {module.replace('_', '-')}\nVersion: 1.0.0\n",
        f"{info}/WHEEL": "Wheel-Version: 1.0\nGenerator: tests\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
        f"{info}/entry_points.txt": points,
    }
    path = folder / f"{module}-1.0.0-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as wheel:
        for name, text in files.items():
            wheel.writestr(name, text)
        wheel.writestr(f"{info}/RECORD", "".join(f"{name},,\n" for name in (*files, f"{info}/RECORD")))
    return path


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
    """Build packages that are no wheels yet, and install all into the folder ``target``."""
    folders = [package for package in packages if package.is_dir()]
    wheels = [package for package in packages if not package.is_dir()]
    with tempfile.TemporaryDirectory() as built:
        wheels += build_wheels(folders, Path(built)) if folders else []
        command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index"]
        command += ["--disable-pip-version-check", "--target", str(target), *map(str, wheels)]
        ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    return target


class Command:
    """``slamhive`` in a process of its own.

    Args:
        carry_out: What :func:`tests.forked_commands.forked_commands` yields.
        root: The project folder.
        data: The data root.
        plugins: The folders of installed plug-ins.
    """

    def __init__(self, carry_out: Run, root: Path, data: Path, *plugins: Path, **settings: str) -> None:
        self._carry_out = carry_out
        share_environments(data)
        own = {f"SLAMHIVE_{key.upper()}": value for key, value in settings.items()}
        self.environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(map(str, (CHECKOUT, *plugins))),
            "SLAMHIVE_ROOT": str(root),
            "SLAMHIVE_DATA": str(data),
            "SLAMHIVE_EXECUTOR": "process",
            "SLAMHIVE_MIN_FREE_DISK_MB": "1",
            "SLAMHIVE_POLL_INTERVAL_S": "0.02",
            **own,
        }

    def run(self, *arguments: str, expected: int = 0) -> subprocess.CompletedProcess[str]:
        """Run one command to its end; it must end with the exit code ``expected``."""
        ended = self._carry_out(arguments, self.environment)
        assert ended.returncode == expected, ended.stdout + ended.stderr
        return ended

    def json(self, *arguments: str, expected: int = 0) -> Any:
        """What a command prints with ``--json``."""
        return json.loads(self.run(*arguments, "--json", expected=expected).stdout)
