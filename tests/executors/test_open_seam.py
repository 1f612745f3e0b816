"""No caller asks which executor it has: it asks what the executor can do."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import slamhive
from slamhive.executors.registry import EXECUTORS

ROOT = Path(slamhive.__file__).parent
TABLE = ROOT / "executors" / "registry.py"
"""The table of what ships with the project. It is the only place besides an executor's own package with its name."""


def names_in(path: Path, names: set[str]) -> Iterator[str]:
    """Where a text is a name, or tells users which executor to take; which ones there are follows from the plug-ins."""
    either = "|".join(sorted(names))
    advice = re.compile(rf"executors? ({either})\b|({either}) or ({either})\b|({either}) executor\b")
    tree = ast.parse(path.read_text(encoding="utf-8"))
    explained = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if not isinstance(node, ast.Constant) or not isinstance(node.value, str) or id(node) in explained:
            continue
        if node.value in names or advice.search(node.value):
            yield f"{path.relative_to(ROOT)}:{node.lineno}: {node.value!r}"


def own_package(name: str) -> Path:
    return ROOT / "executors" / name


@pytest.mark.integration
def test_no_name_of_an_executor_outside_its_package():
    names = {name for name in EXECUTORS.names() if own_package(name).is_dir()}
    assert len(names) == 4
    homes = {own_package(name) for name in names}
    strangers = [path for path in ROOT.rglob("*.py") if path != TABLE and not homes & set(path.parents)]
    assert len(strangers) > 300
    found = [place for path in strangers for place in names_in(path, names)]
    assert found == []


def test_executors_do_not_know_each_other():
    """Slurm starts the supervisor of processes, and Kubernetes has images of Docker: the others know nobody."""
    names = ("docker", "process", "slurm", "kubernetes", "registry")
    for name in ("docker", "process"):
        others = {f"slamhive.executors.{other}" for other in names if other != name}
        for path in own_package(name).glob("*.py"):
            imported = {
                node.module or ""
                for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
                if isinstance(node, ast.ImportFrom)
            }
            assert not [module for module in imported if module.startswith(tuple(others))], path


def test_the_name_in_the_table_is_that_of_the_class():
    from slamhive.executors.docker.executor import DockerExecutor  # noqa: PLC0415 - the SDK takes long to load
    from slamhive.executors.process.executor import ProcessExecutor  # noqa: PLC0415

    assert {DockerExecutor.name, ProcessExecutor.name} <= set(EXECUTORS.names())
