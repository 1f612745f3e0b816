"""What the page of an analysis needs: the report without the data that only plots and files show."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from slamhive.analysis.print_chart import FORMATS
from slamhive.analysis.result import FormResult
from slamhive.analysis.result_json import from_json, to_json
from slamhive.services.reports.bundle import shown_form
from slamhive.services.reports.report import file_name


def page_json(report: Mapping[str, Any]) -> dict[str, Any]:
    """The report for :mod:`slamhive.services.analyses.stored_page`: plots without marks, tables cut to what is shown.

    It includes the names of all files.
    """
    return {
        **{key: value for key, value in report.items() if key != "forms"},
        "forms": [_light(form) for form in report["forms"]],
        "files": {name: place for form in report["forms"] for name, place in _files(form)},
    }


def _light(form: dict[str, Any]) -> dict[str, Any]:
    shown = shown_form(form)
    charts = [to_json(replace(chart, marks=())) for chart in shown["charts"]]
    tables = [
        entry | {"table": to_json(replace(entry["table"], rows=entry["rows"])), "rows": None}
        for entry in shown["tables"]
    ]
    return {**shown, "charts": charts, "tables": tables}


def _files(form: dict[str, Any]) -> list[tuple[str, list[Any]]]:
    """The files of one part of a report by name, with the number of the part and the key of its plot or table."""
    if form["result"] is None:
        return []
    result: FormResult = from_json(form["result"])
    place = form["place"]
    found = [(file_name(place, chart.key, ending), [place, chart.key]) for chart in result.charts for ending in FORMATS]
    for table in result.tables:
        endings = ("csv", "parquet") if table.raw else ("csv", "parquet", "tex")
        found += [(file_name(place, table.key, ending), [place, table.key]) for ending in endings]
    return found
