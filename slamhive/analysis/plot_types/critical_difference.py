"""Critical-difference diagram: mean ranks of competitors over datasets, and which of them differ."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np
from pydantic import Field

from slamhive.analysis.chart import REFERENCE, Array, Axis, Chart, Labels, Mark, Segments
from slamhive.analysis.plot_types import base
from slamhive.analysis.plot_types.looks import settings_words
from slamhive.analysis.report import Cell, PlotResult, ResultTable, TableColumn
from slamhive.analysis.statistics import RankTest, compare_means, rank_test
from slamhive.analysis.table import FAILED, RunTable
from slamhive.base.errors import InvalidInput
from slamhive.domain.metrics import Direction

_ROW = 0.32
_TICK_LABELS = 10
_LETTERS = 45
"""Longer names are shortened in the diagram; the table shows them in full."""
_COMPETITOR = "competitor"
_Values = dict[str, dict[str, Array]]


class CriticalDifferenceOptions(base.PlotOptions):
    """``of`` says who competes; each dataset is one block."""

    metric: str = Field(default="ate.rmse", description="Metric to rank by.")
    of: Literal["algorithm", "settings"] = Field(
        default="algorithm", description="Competitors: algorithms, or each algorithm with its parameters."
    )
    test: Literal["nemenyi", "wilcoxon-holm"] = Field(
        default="nemenyi", description="Test of pairs, after Friedman's test."
    )
    significance: float = Field(default=0.05, gt=0, lt=0.5, description="Significance level of the tests.")


class CriticalDifference(base.PlotType[CriticalDifferenceOptions]):
    """The plot type ``critical_difference``."""

    key = "critical_difference"
    title = "Critical differences"
    description = (
        "Friedman's test over datasets, mean ranks, which competitors differ, and how many repeats are missing."
    )
    options = CriticalDifferenceOptions
    column_options = ("metric",)

    def build(self, data: base.PlotData, options: CriticalDifferenceOptions) -> PlotResult:
        """The diagram, a table of pairs with the repeats that would decide, the raw data."""
        table = data.table.require_runs()
        column = base.directed(table, options.metric, "a rank")
        base.with_values(table, [column.key])
        protocol = table.one_protocol([column.key])
        competitors = table.frame["algorithm"].astype(str)
        if options.of == "settings":
            competitors = competitors + ", " + settings_words(table)
        table = table.with_rows(table.frame.assign(**{_COMPETITOR: competitors}))
        names, blocks, scores = _scores(table, options.metric)
        test = rank_test(scores, options.test, options.significance)
        words = "Nemenyi" if options.test == "nemenyi" else "Wilcoxon-Holm"
        not_rejected = "" if test.p_value < options.significance else " (equality of all is not rejected)"
        chart = Chart(
            key=f"critical_difference_{column.key}",
            title=options.title or f"Ranks by {column.label} over {len(blocks)} datasets",
            x=Axis("mean rank (1 is best)"),
            y=Axis(""),
            marks=tuple(_diagram(names, test)),
            caption=base.caption(
                table,
                len(table.frame),
                protocol,
                f"Friedman p = {test.p_value:.3g} over {len(blocks)} datasets{not_rejected}; bars join competitors "
                f"without a significant difference by {words} at {options.significance:g}. All runs of a dataset are "
                "ranked together, failed ones last; the rank of a competitor is the mean rank of its runs.",
            ),
            bare=True,
            height=0.5 + 0.07 * len(names),
        )
        tables = (_pairs(names, test, table, options), base.raw_table("critical_difference_raw", table, [column.key]))
        return base.result_of(table, protocol, (chart,), tables, lacking=[column.key])


def _scores(table: RunTable, metric: str) -> tuple[list[str], list[str], Array]:
    """Competitors, datasets, and the mean rank of each competitor's runs among all runs of a dataset.

    A failed run has the worst rank, so that failures never improve a rank. Datasets count if every competitor was run
    on them, even if its runs failed.
    """
    sign = -1.0 if table.column(metric).direction is Direction.HIGHER else 1.0
    runs = table.frame[table.frame[FAILED].notna() | table.frame[metric].notna()]
    costs = (sign * runs[metric]).where(runs[FAILED].isna(), np.inf)
    ranks = costs.groupby(runs["dataset"]).rank(method="average")
    ranked = runs.assign(rank=ranks)
    means = ranked.pivot_table(index="dataset", columns=_COMPETITOR, values="rank", aggfunc="mean")
    means = means.reindex(columns=sorted(table.frame[_COMPETITOR].unique())).dropna(axis=0)
    if means.empty:
        raise InvalidInput("no dataset was run with every competitor", "narrow the selection to a full grid")
    return [str(name) for name in means.columns], [str(name) for name in means.index], means.to_numpy(dtype=float)


def _diagram(names: list[str], test: RankTest) -> Iterator[Mark]:
    """Drawn as in Demsar (2006), fig. 1: labels of the better half on the left, the others on the right."""
    order = np.argsort(test.mean_ranks, kind="stable")
    count = len(names)
    ticks = np.arange(1, count + 1, dtype=float)
    yield _strokes([1.0], [0.0], [float(count)], [0.0])
    yield _strokes(ticks, np.zeros(count), ticks, np.full(count, 0.12))
    named = ticks[:: -(-count // _TICK_LABELS)]
    yield Labels(named, np.full(len(named), 0.15), tuple(f"{tick:g}" for tick in named), anchor="centre")
    half = (count + 1) // 2
    cliques = test.cliques()
    below = -_ROW * (len(cliques) * 0.5 + 0.6)
    for place, competitor in enumerate(order):
        rank = float(test.mean_ranks[competitor])
        left = place < half
        row = place if left else count - 1 - place
        height = below - _ROW * row
        end = 0.7 if left else count + 0.3
        yield _strokes([rank, rank], [0.0, height], [rank, end], [height, height])
        name = names[competitor]
        text = f"{name if len(name) <= _LETTERS else name[: _LETTERS - 1] + '…'} ({rank:.2f})"
        yield Labels(np.array([end]), np.array([height]), (text,), anchor="right" if left else "left")
    for level, clique in enumerate(cliques):
        ranks = test.mean_ranks[list(clique)]
        height = -_ROW * 0.5 * (level + 0.7)
        yield _strokes([ranks.min() - 0.03], [height], [ranks.max() + 0.03], [height], width=4.0)
    if test.critical_difference is not None:
        yield _strokes([1.0], [0.55], [1.0 + test.critical_difference], [0.55], width=2.5)
        middle = np.array([1.0 + test.critical_difference / 2])
        yield Labels(middle, np.array([0.6]), (f"critical difference {test.critical_difference:.2f}",), "centre")


def _strokes(x0: object, y0: object, x1: object, y1: object, width: float = 1.2) -> Segments:
    from_x, from_y, to_x, to_y = (np.asarray(part, dtype=float) for part in (x0, y0, x1, y1))
    return Segments(from_x, from_y, to_x, to_y, colour=REFERENCE, width=width)


def _pairs(names: list[str], test: RankTest, table: RunTable, options: CriticalDifferenceOptions) -> ResultTable:
    """Each pair: whether ranks differ, and on how many datasets repeats decide or how many more would."""
    columns = (
        TableColumn("first", "First"),
        TableColumn("second", "Second"),
        TableColumn("p", "p, corrected"),
        TableColumn("told_apart", "Ranks differ"),
        TableColumn("decided", "Datasets decided by repeats"),
        TableColumn("undecided", "Undecided"),
        TableColumn("too_few", "Too few repeats"),
        TableColumn("more", "More repeats that would decide"),
        TableColumn("never", "Undecided by any number of repeats"),
    )
    values = _values(table, options.metric)
    rows: list[tuple[Cell, ...]] = []
    for (first, second), p_value in sorted(test.pairs.items()):
        apart = "no" if test.same(first, second) else "yes"
        repeats = _repeats(values, (names[first], names[second]))
        rows.append((names[first], names[second], p_value, apart, *repeats))
    note = (
        "A dataset is decided if Welch's 95 % interval of the difference of the two means excludes 0; this needs two "
        "good runs of each. More repeats: how many of each would decide the undecided datasets at the present spread. "
        "The last column lists datasets that a million repeats would not decide, because the means are almost equal."
    )
    return ResultTable("pairs", "Pairs", columns, tuple(rows), note)


def _values(table: RunTable, metric: str) -> _Values:
    """{dataset: {competitor: values of its good runs}}, read once for all pairs; datasets in order."""
    found: _Values = {}
    for (dataset, name), rows in table.frame.groupby(["dataset", _COMPETITOR], sort=True, observed=True):
        found.setdefault(str(dataset), {})[str(name)] = base.good_values(rows, metric)
    return found


def _repeats(values: _Values, names: tuple[str, str]) -> tuple[int, int, int, int | None, str | None]:
    """Datasets decided, undecided, and with fewer than two good runs of a competitor; missing repeats; hopeless ones.

    The last entry lists the datasets that no number of repeats decides.
    """
    decided = undecided = too_few = 0
    missing: list[int] = []
    never: list[str] = []
    for dataset, by_name in values.items():
        if not by_name.keys() >= set(names):
            continue
        groups = [by_name[name] for name in names]
        if min(map(len, groups)) < 2:
            too_few += 1
            continue
        comparison = compare_means(groups[0], groups[1])
        decided += comparison.decided
        undecided += not comparison.decided
        if comparison.decided:
            continue
        if comparison.repeats_to_decide is None:
            never.append(dataset)
        else:
            missing.append(max(1, comparison.repeats_to_decide - min(map(len, groups))))
    return decided, undecided, too_few, max(missing, default=None), ", ".join(never) or None
