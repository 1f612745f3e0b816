"""A report as files: a self-contained page, plots for print, tables with all data; in a folder or a zip file."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import plotly
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from slamhive.analysis.chart import PRINT_FORMATS
from slamhive.analysis.plotly_chart import plotly_figure
from slamhive.analysis.report import Plot, RawData, Report, ShownPlot, ShownTable
from slamhive.analysis.result import ResultTable
from slamhive.files import write_aside
from slamhive.services.markdown import markdown_html
from slamhive.services.reports.report import SHOWN_ROWS, file_name
from slamhive.services.reports.tables import endings_of, parquet_there, table_file

PLOTLY_FILE = Path(plotly.__file__).parent / "package_data" / "plotly.min.js"
PAGE = "report.html"

Progress = Callable[[float, str], None]


def report_files(
    report: Report, project_root: Path, formats: Collection[str] = PRINT_FORMATS, progress: Progress | None = None
) -> Iterator[tuple[str, bytes]]:
    """The files of a report, one at a time, each with its path in the folder.

    Args:
        report: From :func:`slamhive.services.reports.report.make_report`.
        project_root: The folder that contains the templates.
        formats: Formats of plots for print, from :data:`slamhive.analysis.chart.PRINT_FORMATS`.
        progress: Called with the fraction done and the title of the current plot.
    """
    # Matplotlib takes a moment to load, which an analysis for the web need not wait for.
    from slamhive.analysis.print_chart import print_chart  # noqa: PLC0415

    tell = progress or (lambda _share, _what: None)
    yield "analysis.yaml", report.source.encode()
    tell(0.0, PAGE)
    yield PAGE, report_page(report, project_root).encode()
    for plot in report.forms:
        tell(plot.place / (len(report.forms) + 1), plot.title)
        for chart in plot.charts:
            for file_format in formats:
                name = file_name(plot.place, chart.key, file_format)
                yield f"figures/{name}", print_chart(chart, file_format)
        for table in plot.tables:
            yield from _table_files(plot.place, table)


def write_folder(
    report: Report,
    project_root: Path,
    folder: Path,
    formats: Collection[str] = PRINT_FORMATS,
    progress: Progress | None = None,
) -> list[Path]:
    """Write the report into ``folder``, each file atomically; returns the paths. Raises Unavailable."""
    written = []
    for name, content in report_files(report, project_root, formats, progress):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_aside(path, content)
        written.append(path)
    return written


def zipped(report: Report, project_root: Path, formats: Collection[str] = PRINT_FORMATS) -> bytes:
    """The report as a zip file; the same report gives the same bytes."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in report_files(report, project_root, formats):
            archive.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), content, zipfile.ZIP_DEFLATED)
    return buffer.getvalue()


def report_page(report: Report, project_root: Path) -> str:
    """One HTML page with styles, plots and the plotting library; it needs no server and no network."""
    template = report_environment(project_root).get_template("analyses/report.html")
    return template.render(
        **report_content(report),
        plotly_js=Markup(PLOTLY_FILE.read_text(encoding="utf-8")),  # noqa: S704 - out of the installed package
        draw_js=Markup((project_root / "static" / "report.js").read_text(encoding="utf-8")),  # noqa: S704 - ours
        style=Markup((project_root / "static" / "report.css").read_text(encoding="utf-8")),  # noqa: S704 - ours
    )


def report_environment(project_root: Path) -> Environment:
    """Templates of pages that are files: they escape text and render Markdown."""
    environment = Environment(
        loader=FileSystemLoader(project_root / "templates"), autoescape=True, undefined=StrictUndefined
    )
    environment.filters["markdown"] = lambda text: Markup(markdown_html(text))  # noqa: S704 - HTML in it is text
    return environment


def report_content(report: Report) -> dict[str, Any]:
    """Template variables of every page of a report: ``report``, ``forms``, and ``figures`` for a script element."""
    return {
        "report": report,
        "forms": [shown_plot(plot) for plot in report.forms],
        "figures": script_json(figures_json(report)),
    }


def shown_plot(plot: Plot) -> ShownPlot:
    """The part of a plot that a page shows: its plots, and its tables with their first rows."""
    return ShownPlot.of(
        plot,
        charts=plot.charts,
        tables=tuple(_shown_table(table) for table in plot.tables if not table.raw),
        raw=tuple(
            RawData(key=table.key, title=table.title, rows=len(table.rows)) for table in plot.tables if table.raw
        ),
        notes=(*(() if plot.result is None else plot.result.notes), *plot.exclusions),
        runs=None if plot.result is None else plot.result.runs,
        failed=None if plot.result is None else plot.result.failed,
    )


def _shown_table(table: ResultTable) -> ShownTable:
    rows = table.rows[:SHOWN_ROWS]
    numeric = tuple(
        column.key
        for place, column in enumerate(table.columns)
        if all(isinstance(row[place], int | float | None) for row in rows)
    )
    return ShownTable(table=replace(table, rows=rows), more=len(table.rows) - SHOWN_ROWS, numeric=numeric)


def figures_json(report: Report) -> dict[str, Any]:
    """{place-key: JSON for Plotly} of all plots of a report."""
    return {f"{plot.place}-{chart.key}": plotly_figure(chart) for plot in report.forms for chart in plot.charts}


def _table_files(place: int, table: ResultTable) -> Iterator[tuple[str, bytes]]:
    for ending in endings_of(table):
        if ending != "parquet" or parquet_there():
            yield f"tables/{file_name(place, table.key, ending)}", table_file(table, ending)


def script_json(content: dict[str, Any]) -> Markup:
    """JSON for a script element, escaped so that it cannot end the element."""
    text = json.dumps(content, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return Markup(text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"))  # noqa: S704 - escaped
