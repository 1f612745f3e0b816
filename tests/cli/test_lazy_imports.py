"""Commands that only read load no library they do not need, and packages give their names on first use."""

from __future__ import annotations

import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

HEAVY = (
    *("cv2", "rosbags", "pandas", "scipy", "docker", "flask", "matplotlib", "evo", "psutil", "alembic"),
    *(
        "slamhive.bags",
        "slamhive.catalogue.algorithm_file",
        "slamhive.evaluation.evaluators",
        "slamhive.services.worker.worker",
    ),
)
SCRIPT = """
import sys
from slamhive.cli import main
from slamhive.client import Hive, RunList
main(sys.argv[2:], standalone_mode=False)
print(*[name for name in sys.argv[1].split(",") if name in sys.modules], file=sys.stderr)
"""
SERVICES = sorted(
    path.parent.name
    for path in (Path(__file__).parents[2] / "slamhive" / "services").glob("*/__init__.py")
    if "lazy_names" in path.read_text(encoding="utf-8")
)


@pytest.mark.integration
@pytest.mark.parametrize("command", [("runs",), ("runs", "--json"), ("search", "list")])
def test_a_reading_command_loads_no_heavy_library(tmp_path: Path, command: tuple[str, ...]) -> None:
    data = tmp_path / "data"
    (data / "datasets").mkdir(parents=True)
    arguments = ["--data", str(data), *command]
    for _ in range(2):  # the first makes the database, which loads Alembic
        done = subprocess.run(
            [sys.executable, "-c", SCRIPT, ",".join(HEAVY), *arguments], capture_output=True, text=True, check=True
        )
    assert done.stderr.splitlines()[-1].strip() == ""


@pytest.mark.parametrize("package", SERVICES)
def test_every_name_of_a_lazy_package_is_there(package: str) -> None:
    module = import_module(f"slamhive.services.{package}")
    assert all(getattr(module, name) is not None for name in module.__all__)
    with pytest.raises(AttributeError, match="no attribute 'no_such_name'"):
        module.no_such_name  # noqa: B018
