"""Each package of ``slamhive/services`` is used through its ``__init__`` alone."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import slamhive

SOURCE = Path(slamhive.__file__).parent
SERVICES = SOURCE / "services"
PACKAGES = sorted(path.parent.name for path in SERVICES.glob("*/__init__.py"))


def modules_reached(path: Path) -> Iterator[str]:
    """The modules inside packages of other use cases that a file imports."""
    own = path.relative_to(SERVICES).parts[0] if path.is_relative_to(SERVICES) else None
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            root, _, rest = name.partition("slamhive.services.")
            package, _, inside = rest.partition(".")
            is_module = (SERVICES / package / f"{inside.partition('.')[0]}.py").exists()
            if not root and package in PACKAGES and package != own and inside and is_module:
                yield name


@pytest.mark.integration
def test_no_module_reaches_into_the_package_of_another_use_case() -> None:
    reached = {
        str(path.relative_to(SOURCE)): found for path in SOURCE.rglob("*.py") if (found := list(modules_reached(path)))
    }
    assert reached == {}


def test_the_check_sees_a_module_that_reaches_into_a_package(tmp_path: Path) -> None:
    path = tmp_path / "caller.py"
    path.write_text(
        "from slamhive.services.runs import RunService\nfrom slamhive.services.runs.record import begin_record\n"
    )
    assert list(modules_reached(path)) == ["slamhive.services.runs.record.begin_record"]


def test_names_that_once_had_two_meanings_have_one() -> None:
    """A reader who is told "see records" would have to ask which."""
    stems = [path.stem for path in Path(slamhive.__file__).parent.rglob("*.py")]
    assert len(stems) > 500
    assert {name: stems.count(name) for name in ("records", "record", "room")} == {
        "records": 1,
        "record": 2,  # the model of run.json, and the service that writes it
        "room": 0,
    }
