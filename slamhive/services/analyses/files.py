"""The files of a stored analysis, created on request, one at a time: printing a plot takes a second."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from slamhive.analysis.report import ReportPage
from slamhive.domain.bibliography import bibtex
from slamhive.errors import NotFound, Unavailable
from slamhive.schema.api_answers import AnalysisWithFile
from slamhive.services.analyses.folder import PAGE, REPORT, SOURCE, AnalysisFolder
from slamhive.services.analyses.stored import StoredAnalyses
from slamhive.store.analysis_records import AnalysisState

MOST_WAIT_S = 30.0
MOST_WAITING = 3
"""Server threads that may wait for files at once. The others stay free for pages."""
MOST_KEPT_BYTES = 50_000_000
MEDIA_TYPES = {
    "pdf": "application/pdf",
    "svg": "image/svg+xml",
    "png": "image/png",
    "csv": "text/csv",
    "tex": "text/x-tex",
    "md": "text/markdown",
    "parquet": "application/vnd.apache.parquet",
    "html": "text/html",
    "zip": "application/zip",
    "yaml": "application/yaml",
    "bib": "text/x-bibtex",
}
PAGE_FILE, ZIP_FILE, BIBLIOGRAPHY = "report.html", "report.zip", "references.bib"
ALWAYS = (SOURCE, PAGE_FILE, ZIP_FILE, BIBLIOGRAPHY)
"""What every report has, besides the files of its plots and tables."""


class AnalysisFiles:
    """Creates files and keeps the latest ones in memory; writes nothing to disk.

    Args:
        stored: The analyses.
        project_root: The folder with ``algorithms/``.
    """

    def __init__(self, stored: StoredAnalyses, project_root: Path) -> None:
        self._stored = stored
        self._project_root = project_root
        self._making = threading.Lock()
        self._places = threading.BoundedSemaphore(1 + MOST_WAITING)
        self._kept: OrderedDict[tuple[str, str, str], bytes] = OrderedDict()
        self._kept_bytes = 0

    def document(self, token: str) -> AnalysisWithFile:
        """One analysis with its text, its progress, and the names of its files; raises NotFound."""
        record, folder = self._stored.get(token), self._stored.folder(token)
        fraction, doing = folder.read_progress()
        done = record.state is AnalysisState.DONE
        return AnalysisWithFile.of(
            record,
            yaml=folder.source,
            fraction=1.0 if done else fraction,
            doing="" if record.state.ended else doing,
            files=(*ALWAYS, *folder.read_result(PAGE)["files"]) if done else (),
        )

    def report(self, token: str) -> dict[str, Any]:
        """The whole report of one analysis as data; raises NotFound before it is done."""
        self._stored.get(token)
        report: dict[str, Any] = self._stored.folder(token).read_result(REPORT)
        return report

    def get(self, token: str, name: str) -> bytes:
        """One file; raises NotFound for an unknown name, and Unavailable while too many files are being created."""
        record, folder = self._stored.get(token), self._stored.folder(token)
        if name == SOURCE:
            return folder.source.encode()
        if name == BIBLIOGRAPHY:
            return bibtex(ReportPage.stored(folder.read_result(PAGE)).references).encode()
        place = None if name in (PAGE_FILE, ZIP_FILE) else _place(folder.read_result(PAGE)["files"], name)
        if place is None and name not in (PAGE_FILE, ZIP_FILE):
            raise NotFound(f"the analysis has no file {name[:100]!r}", "see the list on its page")
        key = token, name, str(record.ended_at)
        content = self._kept.get(key)
        if content is not None:
            return content
        with self._one_at_a_time():
            content = self._kept.get(key)
            if content is None:
                content = self._make(folder, name, place)
                self._keep(key, content)
        return content

    def _make(self, folder: AnalysisFolder, name: str, place: tuple[int, str] | None) -> bytes:
        # matplotlib, pandas and plotly take two seconds to load. No other page should wait for that.
        from slamhive.analysis.chart import PAPER_FORMATS, PRINT_FORMATS  # noqa: PLC0415
        from slamhive.analysis.print_chart import print_chart  # noqa: PLC0415
        from slamhive.analysis.report import Report  # noqa: PLC0415
        from slamhive.services.reports import Printing, file_name, report_page, table_file, zipped  # noqa: PLC0415

        report = Report.stored(folder.read_result(REPORT))
        root = self._project_root
        if place is None:
            printing = Printing((*PRINT_FORMATS, *PAPER_FORMATS))
            return zipped(report, root, printing) if name == ZIP_FILE else report_page(report, root).encode()
        number, wanted = place
        plot = report.forms[number - 1]
        ending = name[len(file_name(number, wanted, "")) :]
        if ending in (*PRINT_FORMATS, *PAPER_FORMATS):
            return print_chart(next(chart for chart in plot.charts if chart.key == wanted), ending)
        table = next(entry for entry in plot.tables if entry.key == wanted)
        return table_file(table, ending)

    def _keep(self, key: tuple[str, str, str], content: bytes) -> None:
        self._kept[key] = content
        self._kept_bytes += len(content)
        while self._kept_bytes > MOST_KEPT_BYTES:
            self._kept_bytes -= len(self._kept.popitem(last=False)[1])

    @contextmanager
    def _one_at_a_time(self) -> Iterator[None]:
        busy = Unavailable("too many analysis files are being created", "try again in a minute")
        if not self._places.acquire(blocking=False):
            raise busy
        try:
            if not self._making.acquire(timeout=MOST_WAIT_S):
                raise busy
            try:
                yield
            finally:
                self._making.release()
        finally:
            self._places.release()


def _place(files: dict[str, tuple[int, str]], name: str) -> tuple[int, str] | None:
    """The place of a file's plot and the key; older analyses list neither Markdown nor plots for papers."""
    others = (name.removesuffix(new) + old for new, old in _OLDER if name.endswith(new))
    return next((files[known] for known in (name, *others) if known in files), None)


_OLDER = ((".md", ".tex"), (".88mm.pdf", ".pdf"), (".180mm.pdf", ".pdf"))
"""{ending of a file: the ending of one that older analyses list instead}."""
