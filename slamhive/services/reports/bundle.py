"""A report as files: a self-contained page, plots for print, tables with all data; in a folder or a zip file."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import plotly
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from slamhive.analysis.chart import PAPER_FORMATS, PRINT_FORMATS, Font
from slamhive.analysis.plotly_chart import plotly_figure
from slamhive.analysis.report import Plot, RawData, Report, ShownPlot, ShownTable
from slamhive.analysis.result import ResultTable
from slamhive.domain.bibliography import bibtex
from slamhive.domain.latex import latex
from slamhive.files import write_aside
from slamhive.services.markdown import markdown_html
from slamhive.services.reports.report import SHOWN_ROWS, WHOLE_ROWS, file_name
from slamhive.services.reports.tables import endings_of, parquet_there, table_file

PLOTLY_FILE = Path(plotly.__file__).parent / "package_data" / "plotly.min.js"
PAGE = "report.html"
BIBLIOGRAPHY = "references.bib"
STYLES = ("report.css", "print.css")
"""Style sheets of pages that are files."""

Progress = Callable[[float, str], None]


@dataclass(frozen=True, slots=True)
class Printing:
    """How the plots of a report are printed.

    Attributes:
        formats: From :data:`slamhive.analysis.chart.PRINT_FORMATS` and ``PAPER_FORMATS``.
        font: The font; None for the one that fits each format.
    """

    formats: Collection[str] = PRINT_FORMATS
    font: Font | None = None


PRINTING = Printing()


def report_files(
    report: Report, project_root: Path, printing: Printing = PRINTING, progress: Progress | None = None
) -> Iterator[tuple[str, bytes]]:
    """The files of a report, one at a time, each with its path in the folder.

    Args:
        report: From :func:`slamhive.services.reports.report.make_report`.
        project_root: The folder that contains the templates.
        printing: How its plots are printed.
        progress: Called with the fraction done and the title of the current plot.
    """
    # Matplotlib takes a moment to load, which an analysis for the web need not wait for.
    from slamhive.analysis.print_chart import print_chart  # noqa: PLC0415

    tell = progress or (lambda _share, _what: None)
    yield "analysis.yaml", report.source.encode()
    yield BIBLIOGRAPHY, bibtex(report.references).encode()
    tell(0.0, PAGE)
    yield PAGE, report_page(report, project_root).encode()
    for plot in report.forms:
        tell(plot.place / (len(report.forms) + 1), plot.title)
        for chart in plot.charts:
            for ending in printing.formats:
                name = file_name(plot.place, chart.key, ending)
                yield f"figures/{name}", print_chart(chart, ending, printing.font)
        for table in plot.tables:
            yield from _table_files(plot.place, table)
    if set(PAPER_FORMATS) <= set(printing.formats):
        yield "figures/figures.tex", _figures_latex(report).encode()


def _figures_latex(report: Report) -> str:
    """An environment of LaTeX for each plot; its caption says what the plot for a paper leaves out."""
    parts = [r"% \usepackage{graphicx}"]
    for plot in report.forms:
        for chart in plot.charts:
            name = file_name(plot.place, chart.key, PAPER_FORMATS[0])
            parts += [
                "",
                r"\begin{figure}",
                r"  \centering",
                rf"  \includegraphics{{{name}}}",
                rf"  \caption{{{latex(chart.title)}. {latex(chart.caption)}}}",
                r"\end{figure}",
            ]
    return "\n".join([*parts, ""])


def write_folder(
    report: Report,
    project_root: Path,
    folder: Path,
    printing: Printing = PRINTING,
    progress: Progress | None = None,
) -> list[Path]:
    """Write the report into ``folder``, each file atomically; returns the paths. Raises Unavailable."""
    written = []
    for name, content in report_files(report, project_root, printing, progress):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_aside(path, content)
        written.append(path)
    return written


def zipped(report: Report, project_root: Path, printing: Printing = PRINTING) -> bytes:
    """The report as a zip file; the same report gives the same bytes."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in report_files(report, project_root, printing):
            archive.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), content, zipfile.ZIP_DEFLATED)
    return buffer.getvalue()


def report_page(report: Report, project_root: Path) -> str:
    """One HTML page with styles, plots and the plotting library; it needs no server and no network."""
    template = report_environment(project_root).get_template("analyses/report.html")
    return template.render(
        **report_content(report),
        plotly_js=Markup(PLOTLY_FILE.read_text(encoding="utf-8")),  # noqa: S704 - out of the installed package
        draw_js=Markup(_static(project_root, "report.js")),  # noqa: S704 - ours
        style=Markup("".join(_static(project_root, name) for name in STYLES)),  # noqa: S704 - ours
    )


def _static(project_root: Path, name: str) -> str:
    return (project_root / "static" / name).read_text(encoding="utf-8")


def report_environment(project_root: Path) -> Environment:
    """Templates of pages that are files: they escape text and render Markdown."""
    environment = Environment(
        loader=FileSystemLoader(project_root / "templates"), autoescape=True, undefined=StrictUndefined
    )
    environment.filters["markdown"] = lambda text: Markup(markdown_html(text))  # noqa: S704 - HTML in it is text
    return environment


def report_content(report: Report) -> dict[str, Any]:
    """Template variables of every page of a report that is a file; its tables have all rows, to print them."""
    return {
        "report": report,
        "bibliography": bibtex(report.references),
        "forms": [shown_plot(plot, WHOLE_ROWS) for plot in report.forms],
        "figures": script_json(figures_json(report)),
    }


def shown_plot(plot: Plot, most_rows: int = SHOWN_ROWS) -> ShownPlot:
    """The part of a plot that a page shows: its plots, and its tables with their first rows."""
    return ShownPlot.of(
        plot,
        charts=plot.charts,
        tables=tuple(_shown_table(table, most_rows) for table in plot.tables if not table.raw),
        raw=tuple(
            RawData(key=table.key, title=table.title, rows=len(table.rows)) for table in plot.tables if table.raw
        ),
        notes=(*(() if plot.result is None else plot.result.notes), *plot.exclusions),
        runs=None if plot.result is None else plot.result.runs,
        failed=None if plot.result is None else plot.result.failed,
    )


def _shown_table(table: ResultTable, most_rows: int) -> ShownTable:
    rows = table.rows[:most_rows]
    shown = replace(table, rows=rows)
    numeric = tuple(column.key for place, column in enumerate(table.columns) if shown.is_number(place))
    return ShownTable(table=shown, more=len(table.rows) - most_rows, numeric=numeric)


def figures_json(report: Report) -> dict[str, Any]:
    """{place-key: JSON for Plotly} of all plots of a report."""
    return {f"{plot.place}-{chart.key}": plotly_figure(chart) for plot in report.forms for chart in plot.charts}


def _table_files(place: int, table: ResultTable) -> Iterator[tuple[str, bytes]]:
    for ending in endings_of(table):
        if ending != "parquet" or parquet_there():
            yield f"tables/{file_name(place, table.key, ending)}", table_file(table, ending)


def script_json(content: Any) -> Markup:
    """JSON for a script element, escaped so that it cannot end the element."""
    text = json.dumps(content, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return Markup(text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"))  # noqa: S704 - escaped
