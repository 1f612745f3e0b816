"""What is behind the store's door stays there: its connection, and the repositories that use it."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import slamhive
from slamhive.store import Transaction

PACKAGE = Path(slamhive.__file__).parent
REPOSITORIES = set(Transaction.__annotations__.values())


def trespasses(source: str) -> list[str]:
    """Where code outside the store has a connection or makes a repository."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Attribute) and node.attr == "database":
            found.append(f"line {node.lineno}: {ast.unparse(node)}")
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("slamhive.store"):
            found += [f"line {node.lineno}: {entry.name}" for entry in node.names if entry.name in REPOSITORIES]
    return found


@pytest.mark.integration
def test_nobody_else_has_a_connection_or_makes_a_repository() -> None:
    assert len(REPOSITORIES) >= 15
    outside = [path for path in sorted(PACKAGE.rglob("*.py")) if path.relative_to(PACKAGE).parts[0] != "store"]
    found = {str(path): problems for path in outside if (problems := trespasses(path.read_text()))}
    assert found == {}


def test_a_trespass_is_found() -> None:
    source = "from slamhive.store.ledger import ArchiveRepository\nstore.read(lambda t: t.database.execute(q))"
    assert trespasses(source) == ["line 1: ArchiveRepository", "line 2: t.database"]
