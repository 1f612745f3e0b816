"""The part of a report that its page shows; plots and files read the rest."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from slamhive.analysis.chart import PAPER_FORMATS, PRINT_FORMATS
from slamhive.analysis.report import Plot, Report, ReportPage, ShownPlot
from slamhive.services.reports.bundle import shown_plot
from slamhive.services.reports.report import file_name
from slamhive.services.reports.tables import endings_of


def page_of(report: Report) -> ReportPage:
    """The report without marks of plots and with the first rows of tables; and the names of all files."""
    return ReportPage.of(
        report,
        forms=tuple(map(_light, report.forms)),
        files={name: place for plot in report.forms for name, place in _files(plot)},
    )


def _light(plot: Plot) -> ShownPlot:
    shown = shown_plot(plot)
    return shown.model_copy(update={"charts": tuple(replace(chart, marks=()) for chart in shown.charts)})


def _files(plot: Plot) -> Iterator[tuple[str, tuple[int, str]]]:
    """Each file of a plot by its name, with the place of the plot and the key of the plot or table."""
    for chart in plot.charts:
        for ending in (*PRINT_FORMATS, *PAPER_FORMATS):
            yield file_name(plot.place, chart.key, ending), (plot.place, chart.key)
    for table in plot.tables:
        for ending in endings_of(table):
            yield file_name(plot.place, table.key, ending), (plot.place, table.key)
