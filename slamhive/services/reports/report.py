"""Making the report of an analysis, from which pages and files are made."""

from __future__ import annotations

from collections import Counter
from datetime import datetime
from typing import TYPE_CHECKING

from slamhive.analysis.analysis_file import set_words
from slamhive.analysis.report import DisturbedRuns, Plot, ProtocolRuns, Report
from slamhive.analysis.table import FAILED
from slamhive.domain.bibliography import Reference
from slamhive.domain.trajectory_kind import TrajectoryKind, with_trajectory
from slamhive.services.reports.run import AnalysisOutcome, PlotOutcome

if TYPE_CHECKING:
    import pandas as pd

SHOWN_ROWS = 200
"""Rows of a table on a page of the server; the CSV file has all rows."""

WHOLE_ROWS = 5_000
"""Rows of a table in a page that is a file. Tables that are shown are summaries, with fewer rows than this."""


def make_report(outcome: AnalysisOutcome, now: datetime, references: tuple[Reference, ...] = ()) -> Report:
    """The whole report, with plots and raw data, computed at ``now``; ``references`` are what to cite for it."""
    analysis, table = outcome.analysis, outcome.table
    reasons = Counter(table.failed()[FAILED])
    protocols = table.frame.dropna(subset=["protocol"]).groupby("protocol", sort=True)
    return Report(
        name=analysis.name,
        text=analysis.text,
        made_at=now,
        selection=analysis.selection_words,
        sets={name: set_words(chosen) for name, chosen in sorted(analysis.sets.items())},
        runs=len(table.frame),
        configurations=int(table.frame["configuration_id"].nunique()),
        algorithms=tuple(sorted(table.frame["algorithm"].unique())),
        datasets=tuple(sorted(table.frame["dataset"].unique())),
        failed=outcome.failed_runs,
        failed_because=dict(sorted(reasons.items())),
        unevaluated=table.not_evaluated,
        disturbance=DisturbedRuns(
            disturbed=len(table.disturbed()),
            unknown=int(table.frame["disturbed"].isna().sum()),
            left_out=table.without_disturbed,
        ),
        mixed_versions=table.mixed_versions,
        mixed_trajectories=table.mixed_trajectories,
        mixed_cpus=table.mixed_cpus,
        rule=table.rule_words,
        protocols=tuple(
            ProtocolRuns(fingerprint=str(name), label=_label(rows), runs=len(rows)) for name, rows in protocols
        ),
        references=references,
        forms=tuple(_plot(plot, place) for place, plot in enumerate(outcome.plots, start=1)),
        source=analysis.source,
    )


def _label(rows: pd.DataFrame) -> str:
    """The label of the protocol of runs; it names the kind of their trajectories if all have one."""
    kinds = set(rows["trajectory"].dropna()) if rows["trajectory"].notna().all() else set()
    return with_trajectory(str(rows["protocol_label"].iloc[0]), TrajectoryKind(*kinds) if len(kinds) == 1 else None)


def _plot(plot: PlotOutcome, place: int) -> Plot:
    return Plot(
        place=place,
        form=plot.request.plot_type.key,
        title=plot.title,
        description=plot.request.plot_type.description,
        text=plot.request.options.text,
        error=plot.error,
        result=plot.result,
    )


def file_name(place: int, key: str, ending: str) -> str:
    """``03_scatter_ate.rmse.pdf``: files are numbered in the order of the plots."""
    return f"{place:02d}_{key}.{ending}"
