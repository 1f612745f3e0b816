"""Constraint selector: a ranking of the configurations that keep all bounds, and what was never tested."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from pydantic import Field

from slamhive.analysis.analysis_model import read_by
from slamhive.analysis.chart import Array, Axis, Bars, Chart
from slamhive.analysis.plot_types import base
from slamhive.analysis.plot_types.looks import settings_words
from slamhive.analysis.report import Cell, PlotResult, ResultTable, TableColumn
from slamhive.analysis.statistics import Summary, summarise
from slamhive.analysis.table import FAILED, Column, RunTable
from slamhive.base.errors import InvalidInput
from slamhive.domain.metrics import Direction

_BOUND = re.compile(r"\s*(?P<key>[\w.:+/-]+)\s*(?P<sign><=|=>|>=|<|>)\s*(?P<number>[-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*")
_SHOWN = 20


@dataclass(frozen=True, slots=True)
class SelectorBound:
    """A limit for the metric ``key``."""

    key: str
    sign: str
    limit: float

    def holds(self, values: Array) -> Array:
        """Mark the values that keep the bound; a missing value does not."""
        compare = {"<": np.less, "<=": np.less_equal, ">": np.greater, ">=": np.greater_equal}[self.sign]
        return np.isfinite(values) & compare(values, self.limit)


@dataclass(frozen=True, slots=True)
class RankedCandidate:
    """One algorithm with one set of parameters, over all selected datasets."""

    algorithm: str
    configurations: tuple[int, ...]
    settings: str
    runs: int
    failed: int
    kept: int
    datasets: int
    score: Summary | None


def parse_bound(text: str) -> SelectorBound:
    """``ate.rmse < 0.1``; raises InvalidInput."""
    match = _BOUND.fullmatch(text)
    try:
        if match is not None:
            sign = match["sign"].replace("=>", ">=")
            return SelectorBound(match["key"], sign, float(match["number"]))
    except ValueError:
        pass
    raise InvalidInput(f"bound {text!r} is not METRIC < NUMBER", "write for example: ate.rmse < 0.1")


class SelectorOptions(base.PlotOptions):
    """Bounds that runs must keep, written like filters: ``ate.rmse < 0.1``."""

    bounds: list[Annotated[str, read_by(parse_bound)]] = Field(
        min_length=1,
        max_length=20,
        description="Metric, <, <=, > or >=, number.",
        examples=[["ate.rmse < 0.1", "tracked_fraction > 0.9"]],
    )
    rank_by: str = Field(default="ate.rmse", description="Metric to rank by.")
    kept_share: float = Field(
        default=1.0, gt=0, le=1, description="Share of a configuration's runs that must keep all bounds."
    )


class Selector(base.PlotType[SelectorOptions]):
    """The plot type ``selector``."""

    key = "selector"
    title = "Configurations that keep the bounds"
    description = "A ranking of the configurations that keep all bounds, with evidence, and what was never tested."
    options = SelectorOptions

    def needs(self, options: SelectorOptions) -> frozenset[str]:
        """The bounded metrics and the metric to rank by."""
        return frozenset({options.rank_by, *(parse_bound(text).key for text in options.bounds)})

    def build(self, data: base.PlotData, options: SelectorOptions) -> PlotResult:
        """The ranking with intervals, the ranked table, how many runs keep each bound, what was never tested."""
        table = data.table.require_runs()
        bounds = [parse_bound(text) for text in options.bounds]
        for bound in bounds:
            table.numeric(bound.key, "a bound")
        rank = table.numeric(options.rank_by, "a ranking")
        protocol = table.one_protocol([rank.key, *(bound.key for bound in bounds)])
        frame = table.frame.assign(settings=settings_words(table))
        kept = frame[FAILED].isna().to_numpy(dtype=bool)
        for bound in bounds:
            kept = kept & bound.holds(base.number_column(frame, bound.key))
        frame = frame.assign(kept=kept)
        candidates = []
        for (algorithm, settings), rows in frame.groupby(["algorithm", "settings"], sort=True):
            candidates.append(
                RankedCandidate(
                    algorithm=str(algorithm),
                    configurations=tuple(int(entry) for entry in sorted(rows["configuration_id"].unique())),
                    settings=str(settings),
                    runs=len(rows),
                    failed=base.failed_count(rows),
                    kept=int(rows["kept"].sum()),
                    datasets=int(rows["dataset"].nunique()),
                    score=summarise(base.good_values(rows, options.rank_by)),
                )
            )
        chosen = [entry for entry in candidates if entry.score and entry.kept >= options.kept_share * entry.runs]
        sign = -1.0 if rank.direction is Direction.HIGHER else 1.0
        chosen.sort(
            key=lambda entry: (
                *(-entry.datasets, entry.failed / entry.runs),
                sign * (entry.score.mean if entry.score else 0.0),
            )
        )
        words = " and ".join(_bound_words(bound, table) for bound in bounds)
        under = f"Protocol: {protocol}. " if protocol else ""
        text = (
            f"{len(chosen)} of {len(candidates)} tested settings keep {words} in at least "
            f"{100 * options.kept_share:g} % of their runs. Failed runs keep no bound. {table.rule_words} "
            f"{under}Ranked by number of datasets, share of failed runs, and mean of {rank.label}; "
            "whiskers: 95 % bootstrap interval."
        )
        charts = (_chart(chosen[:_SHOWN], rank, options.title, text, table),) if chosen else ()
        notes = () if chosen else (f"No tested setting keeps {words}.",)

        # Pairs of algorithm and dataset that were never run.
        columns = (TableColumn("algorithm", "Algorithm"), TableColumn("dataset", "Never run on"))
        tested = set(zip(table.frame["algorithm"], table.frame["dataset"], strict=True))
        setups = set(table.frame["sensors"].dropna())
        algorithms = set(table.frame["algorithm"]) | {
            name for name, setup in table.installed.items() if setup in setups
        }
        untested: tuple[tuple[Cell, ...], ...] = tuple(
            (algorithm, dataset)
            for algorithm in sorted(algorithms)
            for dataset in sorted(table.frame["dataset"].unique())
            if (algorithm, dataset) not in tested
        )
        note = "Algorithms of this selection, and installed ones with the same sensors, on its datasets."
        result = base.result_of(
            table,
            protocol,
            charts,
            (
                _ranking(chosen, rank.label, rank.unit, "" if chosen else text),
                _reasons(table, bounds),
                ResultTable("untested", "Never tested", columns, untested, note),
                base.raw_table("selector_raw", table, [rank.key, *(bound.key for bound in bounds)]),
            ),
        )
        return replace(result, notes=notes)


def _bound_words(bound: SelectorBound, table: RunTable) -> str:
    column = table.column(bound.key)
    return f"{column.label} {bound.sign} {bound.limit:g} {column.unit}".rstrip()


def _chart(chosen: list[RankedCandidate], rank: Column, title: str | None, text: str, table: RunTable) -> Chart:
    names = tuple(f"{place}. {entry.algorithm}" for place, entry in enumerate(chosen, start=1))
    scores = [entry.score for entry in chosen if entry.score is not None]
    bars = Bars(
        rank.label,
        np.array([score.mean for score in scores]),
        *base.interval_ends(scores),
        texts=tuple(f"{entry.settings}; n = {score.count}" for entry, score in zip(chosen, scores, strict=True)),
        colours=tuple(table.colours[entry.algorithm] for entry in chosen),
    )
    return Chart(
        key="selector",
        title=title or f"The best {len(chosen)} by {rank.label}",
        x=Axis("rank", categories=names),
        y=Axis(f"{rank.label}, mean", rank.unit),
        marks=(bars,),
        caption=text,
    )


def _ranking(chosen: list[RankedCandidate], label: str, unit: str, text: str) -> ResultTable:
    columns = (
        TableColumn("rank", "Rank"),
        TableColumn("algorithm", "Algorithm"),
        TableColumn("settings", "Settings"),
        TableColumn("configurations", "Configurations"),
        TableColumn("mean", f"{label} mean", unit),
        TableColumn("low", f"{label} 95 % from", unit),
        TableColumn("high", f"{label} 95 % to", unit),
        TableColumn("runs", "Runs"),
        TableColumn("kept", "Within bounds"),
        TableColumn("failed", "Failed"),
        TableColumn("datasets", "Datasets"),
    )
    rows: list[tuple[Cell, ...]] = []
    for place, entry in enumerate(chosen, start=1):
        interval = None if entry.score is None else entry.score.interval
        ends = (None, None) if interval is None else (interval.low, interval.high)
        mean = None if entry.score is None else entry.score.mean
        listed = ", ".join(map(str, entry.configurations[:6])) + (", ..." if len(entry.configurations) > 6 else "")
        counts = (entry.runs, entry.kept, entry.failed, entry.datasets)
        rows.append((place, entry.algorithm, entry.settings, listed, mean, *ends, *counts))
    return ResultTable("ranking", "Ranking", columns, tuple(rows), text)


def _reasons(table: RunTable, bounds: list[SelectorBound]) -> ResultTable:
    """Count the runs of each algorithm that keep each bound."""
    columns = [TableColumn("algorithm", "Algorithm"), TableColumn("runs", "Runs"), TableColumn("failed", "Failed")]
    columns += [
        TableColumn(f"bound{place}", f"{bound.key} {bound.sign} {bound.limit:g} kept by")
        for place, bound in enumerate(bounds)
    ]
    rows: list[tuple[Cell, ...]] = []
    for algorithm, group in table.frame.groupby("algorithm", sort=True):
        good = group[group[FAILED].isna()]
        kept = [int(bound.holds(base.number_column(good, bound.key)).sum()) for bound in bounds]
        rows.append((str(algorithm), len(group), len(group) - len(good), *kept))
    return ResultTable("bounds", "Runs that keep each bound", tuple(columns), tuple(rows))
