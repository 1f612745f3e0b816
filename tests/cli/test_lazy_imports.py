"""Commands that only read load no library they do not need, and packages give their names on first use."""

from __future__ import annotations

import ast
import inspect
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

from benchmarks.search_data import fill, make
from slamhive.store import open_store

HEAVY = (
    *("cv2", "rosbags", "pandas", "scipy", "docker", "flask", "matplotlib", "evo", "psutil", "alembic"),
    *(
        "slamhive.recordings",
        "slamhive.packages.algorithm_file",
        "slamhive.evaluation.evaluators",
        "slamhive.services.worker.worker",
    ),
)
WITH_MODELS = ("pydantic", "numpy", "sqlalchemy.orm", "rich.progress", "slamhive.store.ledger")
"""What a plain list needs as little as the rest. Those that print JSON need pydantic."""

FORBIDDEN = {
    ("runs",): (*HEAVY, *WITH_MODELS),
    ("runs", "--json"): (*HEAVY, "numpy", "sqlalchemy.orm"),
    ("search", "list"): (*HEAVY, *WITH_MODELS),
    ("experiment", "list"): (*HEAVY, "pydantic", "numpy", "sqlalchemy.orm"),
    ("algorithm", "list"): (
        "cv2",
        "rosbags",
        "pandas",
        "scipy",
        "numpy",
        "kubernetes",
        "slamhive.services.worker.worker",
    ),
    ("nodes",): ("cv2", "rosbags", "pandas", "scipy", "numpy", "pydantic", "slamhive.services.worker.worker"),
    ("dataset", "list"): ("cv2", "docker", "slamhive.services.worker.worker", "slamhive.services.fetching"),
}
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


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data root with two runs."""
    data = tmp_path_factory.mktemp("data")
    (data / "datasets").mkdir()
    store = open_store(f"sqlite:///{data / 'slamhive.db'}")
    fill(store, make(2))
    store.close()
    return data


@pytest.mark.integration
@pytest.mark.parametrize("command", FORBIDDEN)
def test_a_reading_command_loads_no_heavy_library(data: Path, command: tuple[str, ...]) -> None:
    words = [sys.executable, "-c", SCRIPT, ",".join(FORBIDDEN[command]), "--data", str(data), *command]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert done.stderr.splitlines()[-1].strip() == ""


@pytest.mark.integration
def test_the_supervisor_of_a_run_loads_no_heavy_library() -> None:
    heavy = {*HEAVY, "numpy", "pydantic", "slamhive.domain"} - {"psutil"}  # which reads the processes of the run
    code = "import sys, slamhive.executors.process.shim; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert heavy.isdisjoint(done.stdout.split())


@pytest.mark.parametrize("package", SERVICES)
def test_every_name_of_a_lazy_package_is_there(package: str) -> None:
    module = import_module(f"slamhive.services.{package}")
    imports = [node for node in ast.walk(ast.parse(inspect.getsource(module))) if isinstance(node, ast.ImportFrom)]
    names = [alias.name for node in imports if str(node.module).startswith("slamhive") for alias in node.names]
    assert len(names) > 1
    assert all(getattr(module, name) is not None for name in names)
    with pytest.raises(AttributeError, match="no attribute 'no_such_name'"):
        module.no_such_name  # noqa: B018
