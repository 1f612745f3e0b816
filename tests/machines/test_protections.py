"""Hostile algorithms in virtual machines: what every context in which people start runs must hold."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.machines.lab import Lab, Machine, built_lab
from tests.machines.table import CONTEXTS, NUMBER, measure

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "protections.md"


class Machines:
    """One machine at a time, of the kernel that the contexts ask for."""

    def __init__(self, lab: Lab) -> None:
        self._lab = lab
        self._stack = ExitStack()
        self._kernel: str | None = None
        self._machine: Machine | None = None

    def of(self, kernel: str) -> Machine:
        """The machine with this kernel command line. Another one is ended first."""
        if self._machine is None or kernel != self._kernel:
            self.close()
            self._machine, self._kernel = self._stack.enter_context(self._lab.machine(NUMBER, kernel)), kernel
        return self._machine

    def close(self) -> None:
        self._stack.close()
        self._machine = None


@pytest.fixture(scope="module")
def machines() -> Iterator[Machines]:
    found = Machines(built_lab())
    yield found
    found.close()


@pytest.mark.machines
@pytest.mark.timeout(1800)  # the first one makes the image of the machines
@pytest.mark.parametrize("context", CONTEXTS, ids=lambda context: f"{context.executor}: {context.name}")
def test_protections_hold_in(machines, context):
    (row,) = measure(machines.of(context.kernel), (context,))
    assert row.broken == []


def test_the_documentation_has_a_row_for_each_context():
    lines = DOCUMENT.read_text(encoding="utf-8").splitlines()
    documented = {tuple(cell.strip() for cell in line.split("|")[1:3]) for line in lines if line.startswith("| ")}
    assert {(context.name, context.executor) for context in CONTEXTS} <= documented
