"""The axis values of an experiment's cells, as arrays that are read once: cells never change."""

from __future__ import annotations

import threading
from collections import Counter, OrderedDict, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slamhive.domain.parameters import Value
from slamhive.errors import unknown
from slamhive.services.experiments.views import MOST_LISTED, Failure, Grid, GridCell, Phase, failure_of
from slamhive.store import Transaction
from slamhive.store.experiment_records import CellRecord, ExperimentRecord, StateCount

MOST_TABLES = 8
"""Kept in memory; one of 100,000 cells and 10 axes takes 5 MB."""

Integers = NDArray[np.int32]
Key = tuple[str, Value | None]
CellCounts = Mapping[int, Sequence[StateCount]]
"""Runs by the number of their cell."""


@dataclass(frozen=True, slots=True)
class AxisTable:
    """The cells of an experiment by axis.

    ``numbers`` and ``configurations``, shape (n,), are the ascending cell numbers and their configurations. For each
    axis, ``values`` holds its values in order of appearance; the last is None if the axis does not apply to some cells.
    ``codes``, shape (n,), holds the index of each cell's value.
    """

    numbers: Integers
    configurations: Integers
    values: Mapping[str, tuple[Value | None, ...]]
    codes: Mapping[str, Integers]

    @classmethod
    def of(cls, cells: Iterable[CellRecord]) -> AxisTable:
        """Build the table from cells in order."""
        numbers: list[int] = []
        configurations: list[int] = []
        places: dict[str, dict[Key, int]] = {}
        found: dict[str, list[int]] = {}
        for cell in cells:
            for axis, value in cell.values.items():
                codes = found.setdefault(axis, [])
                codes += [-1] * (len(numbers) - len(codes))
                own = places.setdefault(axis, {})
                codes.append(own.setdefault((type(value).__name__, value), len(own)))
            numbers.append(cell.number)
            configurations.append(cell.configuration_id)
        values: dict[str, tuple[Value | None, ...]] = {}
        arrays: dict[str, Integers] = {}
        for axis, codes in found.items():
            array = np.array(codes + [-1] * (len(numbers) - len(codes)), dtype=np.int32)
            known = tuple(value for _, value in places[axis])
            values[axis] = (*known, None) if (array < 0).any() else known
            arrays[axis] = np.where(array < 0, np.int32(len(known)), array)
        return cls(np.array(numbers, dtype=np.int32), np.array(configurations, dtype=np.int32), values, arrays)

    @property
    def axes(self) -> dict[str, tuple[Value, ...]]:
        """The axes with all values, in the order of the file."""
        return {axis: tuple(value for value in values if value is not None) for axis, values in self.values.items()}

    def grid(self, axes: tuple[str, str], counts: CellCounts, name: str) -> Grid:
        """Runs by phase over two axes.

        Args:
            axes: The axis of the rows and that of the columns.
            counts: The runs of the cells, without retried ones.
            name: The name of the experiment, for messages.
        """
        rows, columns = (self._axis(axis, name) for axis in axes)
        phases = list(Phase)
        shape = (len(self.values[axes[0]]), len(self.values[axes[1]]))
        place = rows.astype(np.int64) * shape[1] + columns
        used, first, members = np.unique(place, return_index=True, return_counts=True)
        together = np.split(self.configurations[np.argsort(place, kind="stable")], np.cumsum(members)[:-1])
        entries = [(cell, entry) for cell, found in counts.items() for entry in found if not entry.retried]
        index = [phases.index(Phase.of(entry.state, entry.judged)) for _, entry in entries]
        numbers = [(cell, phase, entry.count) for (cell, entry), phase in zip(entries, index, strict=True)]
        table = np.array(numbers, dtype=np.int64).reshape(-1, 3)
        of_cell = place[np.searchsorted(self.numbers, table[:, 0])]
        sums = np.zeros((shape[0] * shape[1], len(phases)), dtype=np.int64)
        np.add.at(sums, (of_cell, table[:, 1]), table[:, 2])
        failures: dict[int, Counter[Failure]] = defaultdict(Counter)
        for at, (_, entry) in zip(of_cell, entries, strict=True):
            failure = failure_of(entry)
            if failure is not None:
                failures[int(at)][failure] += entry.count
        return Grid(
            *axes,
            rows=self.values[axes[0]],
            columns=self.values[axes[1]],
            cells={
                divmod(int(at), shape[1]): GridCell(
                    int(number),
                    int(self.numbers[start]),
                    tuple(map(int, configurations)) if number <= MOST_LISTED else (),
                    dict(zip(phases, map(int, sums[at]), strict=True)),
                    dict(failures.get(int(at), {})),
                )
                for at, start, number, configurations in zip(used, first, members, together, strict=True)
            },
        )

    def _axis(self, axis: str, name: str) -> Integers:
        if axis not in self.codes:
            raise unknown(f"axis of experiment {name}", axis, list(self.codes))
        return self.codes[axis]


class AxisTables:
    """A cache of tables, safe for several threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._tables: OrderedDict[int, AxisTable] = OrderedDict()

    def get(self, t: Transaction, record: ExperimentRecord) -> AxisTable:
        """The table of ``record``; it is not cached while cells are still being stored."""
        with self._lock:
            known = self._tables.get(record.id)
            if known is not None:
                self._tables.move_to_end(record.id)
        if known is not None and len(known.numbers) == record.cells:
            return known
        table = AxisTable.of(t.experiments.cells(record.id, 0, None))
        with self._lock:
            self._tables[record.id] = table
            while len(self._tables) > MOST_TABLES:
                self._tables.popitem(last=False)
        return table
