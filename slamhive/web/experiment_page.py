"""The queries in the addresses of experiment pages: axes of the grid, and position in the table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from werkzeug.datastructures import MultiDict

from slamhive.domain.parameters import Value
from slamhive.errors import unknown
from slamhive.input_bounds import whole_number
from slamhive.schema.submission import MAX_REPEATS
from slamhive.search.grammar import Tree, join
from slamhive.search.syntax import Comparison, Sign, Word, filter_text
from slamhive.sweep.experiment import Experiment
from slamhive.web.formatting import value_text
from slamhive.web.presenters.experiments import default_axes

CELLS_LENGTH = 50
MOST_CELLS = 200
MOST_NUMBER = 2**31 - 1


@dataclass(frozen=True, slots=True)
class GridQuery:
    """The axes of the grid."""

    rows: str
    columns: str

    @classmethod
    def from_args(cls, args: MultiDict[str, str], axes: Mapping[str, int]) -> GridQuery | None:
        """The requested axes, or the most informative ones; None without axes. Raises NotFound for unknown names.

        ``axes``: {name: number of values}.
        """
        if not axes:
            return None
        rows, columns = default_axes(axes)
        return cls(_axis(args.get("rows"), axes, rows), _axis(args.get("columns"), axes, columns))

    def args(self) -> dict[str, str]:
        """The query as arguments of an address."""
        return {"rows": self.rows, "columns": self.columns}


@dataclass(frozen=True, slots=True)
class CellsQuery:
    """A page of the table of configurations: those after number ``after``."""

    after: int = 0
    limit: int = CELLS_LENGTH

    @classmethod
    def from_args(cls, args: MultiDict[str, str]) -> CellsQuery:
        """Read an address; raises InvalidInput naming the argument."""
        after = whole_number(args.get("after", "0"), "after", 0, MOST_NUMBER)
        return cls(after, whole_number(args.get("limit", str(CELLS_LENGTH)), "limit", 1, MOST_CELLS))

    def args(self) -> dict[str, str]:
        """The query as arguments of an address, without the position."""
        return {} if self.limit == CELLS_LENGTH else {"limit": str(self.limit)}


def page_number(args: MultiDict[str, str], pages: int) -> int:
    """The requested page; raises InvalidInput if it does not exist."""
    return whole_number(args.get("page", "1"), "page", 1, pages)


def repeats_count(form: MultiDict[str, str]) -> int:
    """How many repeats to add; raises InvalidInput."""
    return whole_number(form.get("count", ""), "repeats", 1, MAX_REPEATS)


def stated_axes(experiment: Experiment) -> dict[str, int]:
    """{axis: number of values} from the experiment file, without reading the cells."""
    options = (option for step in experiment.steps for option in step.options)
    named = (experiment.algorithms, experiment.datasets, *options, *experiment.parameters)
    return {axis.name: len(axis.values) for axis in named}


def search_of(
    experiment: Experiment, values: Mapping[str, Value | None], configurations: Sequence[int]
) -> dict[str, str] | None:
    """Arguments of the runs page that find the runs with these values; None if no filter can express them.

    Algorithms, datasets and parameters have names to search for. Options of steps do not: a step that changes nothing
    is not stored, and which steps change nothing depends on the recording. In that case ``configurations`` are listed.
    """
    parameters = {axis.name for axis in experiment.parameters if axis.algorithm is None}
    chosen = {"experiment": experiment.name}
    conditions: list[Tree[Comparison]] = []
    for axis, value in values.items():
        if axis in ("algorithm", "dataset"):
            chosen[axis] = str(value)
        elif axis not in parameters or value is None or isinstance(value, tuple):
            return _listed(chosen["experiment"], configurations)
        else:
            conditions.append(Comparison(Word(axis), Sign.EQUAL, (Word(value_text(value)),)))
    return {**chosen, "where": filter_text(join("and", conditions))} if conditions else chosen


def _listed(experiment: str, configurations: Sequence[int]) -> dict[str, str] | None:
    if not configurations:
        return None
    numbers = tuple(Word(str(number)) for number in configurations)
    return {"experiment": experiment, "where": filter_text(Comparison(Word("configuration"), Sign.IN, numbers))}


def _axis(name: str | None, axes: Mapping[str, int], default: str) -> str:
    if not name:
        return default
    if name not in axes:
        raise unknown("axis", name, list(axes))
    return name
