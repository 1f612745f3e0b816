"""The report of an analysis as plain JSON, from which pages and files are made."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from datetime import datetime
from typing import Any

from slamhive.analysis.analysis_file import set_words
from slamhive.analysis.result_json import to_json
from slamhive.analysis.table import FAILED
from slamhive.services.json_values import timestamp
from slamhive.services.reports.run import AnalysisOutcome, PlotOutcome

FORMAT = 1
SHOWN_ROWS = 200
"""Rows of a table on a page; the CSV file has all rows."""


def report_json(outcome: AnalysisOutcome, now: datetime) -> dict[str, Any]:
    """The whole report, with plots and raw data, computed at ``now``."""
    analysis, table = outcome.analysis, outcome.table
    reasons = Counter(table.failed()[FAILED])
    protocols = table.frame.dropna(subset=["protocol"]).groupby("protocol", sort=True)["protocol_label"]
    return {
        "format": FORMAT,
        "name": analysis.name,
        "text": analysis.text,
        "made_at": timestamp(now),
        "selection": analysis.selection_words,
        "sets": {name: set_words(chosen) for name, chosen in sorted(analysis.sets.items())},
        "runs": len(table.frame),
        "configurations": int(table.frame["configuration_id"].nunique()),
        "algorithms": sorted(table.frame["algorithm"].unique()),
        "datasets": sorted(table.frame["dataset"].unique()),
        "failed": outcome.failed_runs,
        "failed_because": dict(sorted(reasons.items())),
        "unevaluated": table.not_evaluated,
        "disturbance": {
            "disturbed": len(table.disturbed()),
            "unknown": int(table.frame["disturbed"].isna().sum()),
            "left_out": table.without_disturbed,
        },
        "rule": table.rule_words,
        "protocols": [
            {"fingerprint": str(name), "label": str(labels.iloc[0]), "runs": len(labels)} for name, labels in protocols
        ],
        "forms": [_plot_json(plot, place) for place, plot in enumerate(outcome.plots, start=1)],
        "source": analysis.source,
    }


def _plot_json(plot: PlotOutcome, place: int) -> dict[str, Any]:
    return {
        "place": place,
        "form": plot.request.plot_type.key,
        "title": plot.title,
        "description": plot.request.plot_type.description,
        "text": plot.request.options.text,
        "error": plot.error,
        "result": None if plot.result is None else to_json(plot.result),
    }


def file_name(place: int, key: str, ending: str) -> str:
    """``03_scatter_ate.rmse.pdf``: files are numbered in the order of the plots."""
    return f"{place:02d}_{key}.{ending}"


def excluded_words(content: Mapping[str, Any]) -> list[str]:
    """The exclusions of a plot, one sentence each."""
    exclusions = (content["result"] or {}).get("excluded", ())
    return [f"{len(entry['runs'])} runs left out: {entry['reason']}." for entry in exclusions]
