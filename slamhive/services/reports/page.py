"""The part of a report that its page shows; plots and files read the rest."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from slamhive.analysis.print_chart import FORMATS
from slamhive.analysis.result import PlotResult
from slamhive.analysis.result_json import from_json, to_json
from slamhive.services.reports.bundle import shown_plot
from slamhive.services.reports.report import file_name


def page_json(report: Mapping[str, Any]) -> dict[str, Any]:
    """The report without marks of plots and with the first rows of tables; and the names of all files."""
    return {
        **{key: value for key, value in report.items() if key != "forms"},
        "forms": [_light(plot) for plot in report["forms"]],
        "files": {name: place for plot in report["forms"] for name, place in _files(plot)},
    }


def _light(plot: dict[str, Any]) -> dict[str, Any]:
    shown = shown_plot(plot)
    charts = [to_json(replace(chart, marks=())) for chart in shown["charts"]]
    tables = [
        entry | {"table": to_json(replace(entry["table"], rows=entry["rows"])), "rows": None}
        for entry in shown["tables"]
    ]
    return {**shown, "charts": charts, "tables": tables}


def _files(plot: dict[str, Any]) -> list[tuple[str, list[Any]]]:
    """Each file of a plot by its name, with the place of the plot and the key of the plot or table."""
    if plot["result"] is None:
        return []
    result: PlotResult = from_json(plot["result"])
    place = plot["place"]
    found = [(file_name(place, chart.key, ending), [place, chart.key]) for chart in result.charts for ending in FORMATS]
    for table in result.tables:
        endings = ("csv", "parquet") if table.raw else ("csv", "parquet", "tex")
        found += [(file_name(place, table.key, ending), [place, table.key]) for ending in endings]
    return found
