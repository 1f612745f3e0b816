"""A report as files: a self-contained page, plots for print, tables with all data; in a folder or a zip file."""

from __future__ import annotations

import csv
import io
import json
import re
import zipfile
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pandas as pd
import plotly
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from slamhive.analysis.chart import PAPER_FORMATS, PRINT_FORMATS, Font
from slamhive.analysis.plotly_chart import plotly_figure
from slamhive.analysis.report import Plot, RawData, Report, ReportPage, ResultTable, ShownPlot, ShownTable
from slamhive.base.errors import Unavailable
from slamhive.base.files import write_aside
from slamhive.domain.bibliography import bibtex, latex
from slamhive.services.analysis.run import SHOWN_ROWS, WHOLE_ROWS, file_name
from slamhive.services.exports import safe_cell
from slamhive.services.markdown import markdown_html, numeric_columns, ranked, table_markdown

LATEX_ROWS = 500
"""Most rows of a printed table; the CSV file has all rows."""

WITHOUT_PARQUET = "Parquet needs pyarrow, which is not installed"
PARQUET_REMEDY = "pip install slamhive[parquet]"

_LATEX_RANKS: Mapping[int | None, str] = {1: r"\textbf{%s}", 2: r"\underline{%s}"}


RAW_ENDINGS = ("csv", "parquet")
ENDINGS = (*RAW_ENDINGS, "tex", "md")
"""File formats of tables; raw data has the first two."""


def endings_of(table: ResultTable) -> tuple[str, ...]:
    """The file formats of a table."""
    return RAW_ENDINGS if table.raw else ENDINGS


def table_file(table: ResultTable, ending: str) -> bytes:
    """The table in the format ``ending``, one of :data:`ENDINGS`; raises Unavailable for Parquet without pyarrow."""
    if ending == "parquet":
        return table_parquet(table)
    return {"csv": table_csv, "tex": table_latex, "md": table_markdown}[ending](table).encode()


def table_csv(table: ResultTable) -> str:
    """Comma-separated text with units in the heading; spreadsheets take no cell for a formula."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([safe_cell(column.heading) for column in table.columns])
    for row in table.rows:
        writer.writerow(["" if value is None else safe_cell(value) for value in row])
    return text.getvalue()


def parquet_there() -> bool:
    """Tell if pyarrow is installed, which writes Parquet files."""
    return find_spec("pyarrow") is not None


def table_parquet(table: ResultTable) -> bytes:
    """A Parquet file; raises Unavailable without pyarrow."""
    frame = pd.DataFrame(list(table.rows), columns=[column.key for column in table.columns])
    for name in frame.columns:
        if any(isinstance(value, str) for value in frame[name]):  # a column of Parquet has one type
            frame[name] = frame[name].map(lambda value: None if pd.isna(value) else str(value))
    buffer = io.BytesIO()
    try:
        frame.to_parquet(buffer, engine="pyarrow", index=False)
    except ImportError:
        raise Unavailable(WITHOUT_PARQUET, PARQUET_REMEDY) from None
    return buffer.getvalue()


def table_latex(table: ResultTable) -> str:
    """A ``table`` with booktabs rules, escaped text and numbers with four significant digits.

    Its caption states what the report states below the table, and so the protocol. A mean and its deviation are one
    formula, without which a cell has only the share of good runs where some failed.
    """
    numeric = numeric_columns(table)
    lines = [
        r"% \usepackage{booktabs}",
        r"\begin{table}",
        r"\centering",
        rf"\caption{{{latex('. '.join(part.rstrip('. ') for part in (table.title, table.caption) if part))}.}}",
        f"\\begin{{tabular}}{{{''.join('r' if number else 'l' for number in numeric)}}}",
        r"\toprule",
        " & ".join(latex(column.heading) for column in table.columns) + r" \\",
        r"\midrule",
    ]
    for place, row in enumerate(table.rows[:LATEX_ROWS]):
        cells = []
        for at, cell in enumerate(row):
            if cell is None:
                text = "--"
            elif isinstance(cell, float):
                text = f"{cell:.4g}"
            elif spread := _SPREAD.match(str(cell)):
                power = rf" \times 10^{{{int(spread[3])}}}" if spread[3] else ""
                text = rf"${spread[1]} \pm {spread[2]}{power}${latex(spread[4] or '')}"
            else:
                text = latex(str(cell))
            cells.append(ranked(text, table.rank(place, at), _LATEX_RANKS))
        lines.append(" & ".join(cells) + r" \\")
    if len(table.rows) > LATEX_ROWS:
        lines.append(f"% {len(table.rows) - LATEX_ROWS} more rows are in the CSV file")
    lines += [r"\bottomrule", r"\end{tabular}", r"\end{table}"]
    return "\n".join([*lines, ""])


_SPREAD = re.compile(r"(-?[\d.]+) ± ([\d.]+)(?:e(-\d+))?( \(.*\))?$")
"""A mean with its standard deviation, as :func:`mean_and_std` writes it."""


def _comment(text: str) -> str:
    return "".join(letter if letter.isprintable() else " " for letter in text)


PLOTLY_FILE = Path(plotly.__file__).parent / "package_data" / "plotly.min.js"
PAGE = "report.html"
BIBLIOGRAPHY = "references.bib"
STYLES = ("tokens.css", "report.css", "print.css")
"""Style sheets of pages that are files."""
DRAWING = ("plots.js", "report.js")
"""Scripts of pages that are files, in this order."""

Progress = Callable[[float, str], None]


@dataclass(frozen=True, slots=True)
class Printing:
    """Print options for the plots of a report.

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
        report: From :func:`slamhive.services.analysis.run.make_report`.
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
            for ending in endings_of(table):
                if ending != "parquet" or parquet_there():
                    yield f"tables/{file_name(plot.place, table.key, ending)}", table_file(table, ending)
    if set(PAPER_FORMATS) <= set(printing.formats):
        # An environment for each plot; its caption says what the plot for a paper leaves out.
        parts = [r"% \usepackage{graphicx}"]
        for plot in report.forms:
            for chart in plot.charts:
                parts += [
                    "",
                    r"\begin{figure}",
                    r"  \centering",
                    rf"  \includegraphics{{{file_name(plot.place, chart.key, PAPER_FORMATS[0])}}}",
                    rf"  \caption{{{latex(chart.title)}. {latex(chart.caption)}}}",
                    r"\end{figure}",
                ]
        yield "figures/figures.tex", "\n".join([*parts, ""]).encode()


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
        draw_js=Markup("".join(_static(project_root, name) for name in DRAWING)),  # noqa: S704 - ours
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
    tables: list[ShownTable] = []
    for table in plot.tables:
        if not table.raw:
            shown = replace(table, rows=table.rows[:most_rows])
            numeric = tuple(column.key for place, column in enumerate(table.columns) if shown.is_number(place))
            tables.append(ShownTable(table=shown, more=len(table.rows) - most_rows, numeric=numeric))
    return ShownPlot.of(
        plot,
        charts=plot.charts,
        tables=tuple(tables),
        raw=tuple(
            RawData(key=table.key, title=table.title, rows=len(table.rows)) for table in plot.tables if table.raw
        ),
        notes=(*plot.notes, *plot.exclusions),
        runs=None if plot.result is None else plot.result.runs,
        failed=None if plot.result is None else plot.result.failed,
    )


def figures_json(report: Report) -> dict[str, Any]:
    """{place-key: JSON for Plotly} of all plots of a report."""
    return {f"{plot.place}-{chart.key}": plotly_figure(chart) for plot in report.forms for chart in plot.charts}


def script_json(content: Any) -> Markup:
    """JSON for a script element, escaped so that it cannot end the element."""
    text = json.dumps(content, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return Markup(text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"))  # noqa: S704 - escaped


# The part of a report that its page shows; plots and files read the rest.


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
