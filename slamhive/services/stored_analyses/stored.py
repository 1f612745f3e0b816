"""Stored analyses: create, list, read and remove them. ``computing`` computes them."""

from __future__ import annotations

import contextlib
import gzip
import json
import re
import secrets
import shutil
import threading
import zlib
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from slamhive.analysis.report import ReportPage
from slamhive.base import strict_yaml
from slamhive.base.bounds import read_record
from slamhive.base.clock import utc_now
from slamhive.base.errors import Forbidden, InvalidInput, NotFound, SlamHiveError, Unavailable
from slamhive.base.files import held_folder, remedy_of, write_aside
from slamhive.base.settings import Mode, Settings
from slamhive.documents.api import AnalysisWithFile
from slamhive.documents.experiment import StoredAnalysis
from slamhive.domain.accounts import Visibility
from slamhive.domain.bibliography import bibtex
from slamhive.services.datasets import check_writable
from slamhive.store import Store
from slamhive.store.records import AnalysisRecord, AnalysisState

SOURCE, STATE, PROGRESS = "analysis.yaml", "state.json", "progress.json"
REPORT, FIGURES, PAGE = "report.json.gz", "figures.json.gz", "page.json.gz"
RESULTS = (REPORT, FIGURES, PAGE)
PREVIEWS = "previews.json"
"""What is computed in place of the results, for a text that is not stored."""


class AnalysisFolder:
    """``<data>/analyses/<token>``.

    Args:
        root: The folder; its name is the token.
    """

    def __init__(self, root: Path) -> None:
        self.root = root

    @property
    def source(self) -> str:
        """The original analysis file; raises NotFound if it is missing."""
        try:
            return (self.root / SOURCE).read_text(encoding="utf-8")
        except FileNotFoundError:
            raise NotFound(f"{self.root} holds no {SOURCE}") from None
        except (OSError, UnicodeDecodeError) as error:
            raise Unavailable(f"{self.root / SOURCE} cannot be read: {error}") from None

    def create(self, source: str, record: AnalysisRecord) -> None:
        """Create the folder, complete or not at all."""
        aside = self.root.with_name(f".{self.root.name}")
        try:
            with held_folder(aside):
                write_aside(aside / SOURCE, source)
                AnalysisFolder(aside).write_state(record)
                aside.rename(self.root)
        except OSError as error:
            shutil.rmtree(aside, ignore_errors=True)
            raise Unavailable(f"{self.root} cannot be made: {error.strerror}", remedy_of(error)) from None
        except Unavailable:
            shutil.rmtree(aside, ignore_errors=True)
            raise

    def write_state(self, record: AnalysisRecord) -> None:
        """Write the state of the table row; a running analysis is written as waiting, so that a restart resumes it."""
        state = record.state if record.state.ended else AnalysisState.QUEUED
        content = StoredAnalysis.of(record, state=state).content
        write_aside(self.root / STATE, json.dumps(content, indent=2) + "\n")

    def read_state(self) -> AnalysisRecord:
        """Read the state; it is waiting if the report is incomplete. Raises InvalidInput."""
        path = self.root / STATE
        content = read_record(path)
        try:
            stored = StoredAnalysis.read(content)
            state = AnalysisState(stored.state)
        except InvalidInput as error:
            raise InvalidInput(f"{path} cannot be used: {error.message}", "restore it, or remove the folder") from None
        except ValueError as error:
            raise InvalidInput(f"{path} cannot be used: {error}", "restore it, or remove the folder") from None
        if state is AnalysisState.DONE and not self.whole:
            state = AnalysisState.QUEUED
        return AnalysisRecord(
            token=self.root.name,
            size_bytes=self.size_bytes,
            **{**stored.model_dump(exclude={"format"}), "state": state},
        )

    @property
    def whole(self) -> bool:
        """True if all results exist."""
        return all((self.root / name).is_file() for name in RESULTS)

    @property
    def size_bytes(self) -> int | None:
        """The total size of the results; None if any is missing."""
        return sum((self.root / name).stat().st_size for name in RESULTS) if self.whole else None

    def write_result(self, name: str, content: Any) -> None:
        """One of :data:`RESULTS`; equal content gives equal bytes."""
        text = json.dumps(content, allow_nan=False, separators=(",", ":"))
        write_aside(self.root / name, gzip.compress(text.encode(), 6, mtime=0))

    def link_results(self, other: AnalysisFolder) -> None:
        """Link the results of another analysis with the same content."""
        for name in RESULTS:
            (self.root / name).unlink(missing_ok=True)
            (self.root / name).hardlink_to(other.root / name)

    def clear_results(self) -> None:
        """Remove the results."""
        for name in (*RESULTS, PROGRESS):
            (self.root / name).unlink(missing_ok=True)

    def read_result(self, name: str) -> Any:
        """Read a result; raises NotFound if it is missing, Unavailable if it is damaged."""
        try:
            return json.loads(gzip.decompress(self.result_bytes(name)))
        except (OSError, EOFError, ValueError, zlib.error) as error:
            remedy = "compute the analysis again"
            raise Unavailable(f"{self.root / name} is damaged: {error}", remedy) from None

    def result_bytes(self, name: str) -> bytes:
        """The same as stored, compressed by gzip."""
        try:
            return (self.root / name).read_bytes()
        except FileNotFoundError:
            raise NotFound("this analysis has not been computed", "wait, or compute it again") from None
        except OSError as error:
            raise Unavailable(f"{self.root / name} cannot be read: {error.strerror}") from None

    def write_progress(self, share: float, doing: str) -> None:
        """Write the progress for the page, without a flush to disk."""
        aside = self.root / f".{PROGRESS}"
        aside.write_text(json.dumps({"share": share, "doing": doing}), encoding="utf-8")
        aside.replace(self.root / PROGRESS)

    def read_progress(self) -> tuple[float, str]:
        """The share done and the current activity; 0 and no text if unknown."""
        with contextlib.suppress(InvalidInput, ValueError, KeyError, TypeError):
            content = read_record(self.root / PROGRESS)
            return float(content["share"]), str(content["doing"])
        return 0.0, ""

    def remove(self) -> None:
        """Remove the folder: rename it in one step, then delete its content."""
        aside = self.root.with_name(f".{self.root.name}")
        with contextlib.suppress(FileNotFoundError):
            self.root.rename(aside)
        shutil.rmtree(aside, ignore_errors=True)


MAX_TEXT_BYTES = 100_000
"""Parsing YAML of this size takes about a second, the limit for a request; ``slamhive analyse`` takes larger files."""
MOST_WAITING = 50
_TOKEN = re.compile(r"[0-9a-f]{32}")


def may_analyse(settings: Settings) -> bool:
    """True if the installation keeps new analyses; in view-only mode they come from visitors and are not listed."""
    return settings.mode is not Mode.VIEW_ONLY or not settings.no_new_analysis


class StoredAnalyses:
    """The stored analyses of an installation, one folder each.

    Args:
        settings: In force.
        store: Their list and queue.
        name_of: Reads the name in an analysis file; raises InvalidInput with the line.
    """

    def __init__(self, settings: Settings, store: Store, name_of: Callable[[str], str]) -> None:
        self._settings = settings
        self._store = store
        self._name_of = name_of

    def check(self, text: str) -> str:
        """Check an analysis file; returns its name; raises InvalidInput with the line."""
        if len(text.encode()) > MAX_TEXT_BYTES:
            remedy = "slamhive analyse takes larger ones"
            raise InvalidInput(f"the analysis file is larger than {MAX_TEXT_BYTES // 1000} kB", remedy)
        return self._name_of(text)

    def create(self, text: str, *, listed: bool = True) -> AnalysisRecord:
        """Store an analysis and queue it. In view-only mode it is a visitor's: not listed, and removed eventually.

        Raises Forbidden if the installation accepts none, Unavailable if too many are waiting.
        """
        if not may_analyse(self._settings):
            raise Forbidden(
                "this installation takes no new analyses", "NO_NEW_ANALYSIS is set; use an installation of your own"
            )
        visitor, maker = self._settings.mode is Mode.VIEW_ONLY, self._store.maker
        name = self.check(text)
        if self._store.read(lambda t: t.analyses.waiting()) >= MOST_WAITING:
            raise Unavailable(f"{MOST_WAITING} analyses are waiting", "try again later")
        record = AnalysisRecord(
            token=secrets.token_hex(16),
            name=name,
            state=AnalysisState.QUEUED,
            listed=listed and not visitor,
            visitor=visitor,
            created_at=utc_now(),
            owner=maker.owner,
            visibility=Visibility.PUBLIC if visitor else maker.visibility,
        )
        if visitor:
            self._make_room()
        folder = self.folder(record.token)
        folder.create(text, record)
        try:
            self._store.write(lambda t: t.analyses.put(record))
        except SlamHiveError:
            folder.remove()
            raise
        return record

    def get(self, token: str) -> AnalysisRecord:
        """One analysis; raises NotFound."""
        if not self.is_token(token):
            raise NotFound("there is no analysis at this address", "check that the address is whole")
        return self._store.read(lambda t: t.analyses.get(token))

    @staticmethod
    def is_token(text: str) -> bool:
        """Tell if a text looks like the token of an analysis."""
        return _TOKEN.fullmatch(text) is not None

    def listed(self, limit: int = 500) -> list[AnalysisRecord]:
        """The listed analyses, newest first."""
        return self._store.read(lambda t: t.analyses.listed(limit))

    def of_experiment(self, name: str, limit: int = 100) -> list[AnalysisRecord]:
        """The listed analyses that select runs of an experiment by its name, among the newest ``limit``."""
        found = []
        for record in self.listed(limit):
            try:
                content = strict_yaml.parse(self.folder(record.token).source, SOURCE)
            except SlamHiveError:
                continue  # the folder is gone or damaged, which its own page says
            chosen = content.get("select")
            sets = chosen.values() if isinstance(chosen, dict) else ()
            if any(isinstance(entry, dict) and entry.get("experiment") == name for entry in sets):
                found.append(record)
        return found

    def folder(self, token: str) -> AnalysisFolder:
        """The folder of an analysis."""
        return AnalysisFolder(self._settings.analyses_folder / token)

    def list_or_not(self, token: str, *, listed: bool) -> AnalysisRecord:
        """List the analysis, or hide it from the list; its URL always works."""
        check_writable(self._settings)
        record = self.get(token)
        folder = self.folder(token)
        folder.write_state(replace(folder.read_state(), listed=listed))
        self._store.write(lambda t: t.analyses.list_or_not(token, listed=listed))
        return replace(record, listed=listed)

    def recompute(self, token: str) -> AnalysisRecord:
        """Queue it again, to be computed from the current runs."""
        check_writable(self._settings)
        self.get(token)
        folder = self.folder(token)
        record = replace(folder.read_state(), state=AnalysisState.QUEUED, content_hash=None, reason=None, ended_at=None)
        folder.write_state(record)
        self._store.write(lambda t: t.analyses.put(replace(record, size_bytes=None)))
        return record

    def delete(self, token: str) -> None:
        """Delete it and end a running computation."""
        check_writable(self._settings)
        self.get(token)
        self._remove(token)

    def restore(self) -> Iterator[tuple[Path, str | None]]:
        """Reindex all folders; yields each folder with None or the reason why it could not be filed."""
        root = self._settings.analyses_folder
        records: list[AnalysisRecord] = []
        for path in sorted(root.iterdir()) if root.is_dir() else ():
            if not _TOKEN.fullmatch(path.name) or path.is_symlink():
                continue
            try:
                records.append(AnalysisFolder(path).read_state())
            except SlamHiveError as error:
                yield path, str(error)
        for record in sorted(records, key=lambda record: (record.created_at, record.token)):
            self._store.write(lambda t, record=record: t.analyses.put(record))  # type: ignore[misc]
            yield root / record.token, None

    def _make_room(self) -> None:
        """Remove the oldest analyses of visitors to make room for one more."""
        kept = self._store.read(lambda t: t.analyses.visitors())
        for record in kept[: max(0, len(kept) - self._settings.analyses_max_stored + 1)]:
            self._remove(record.token)

    def _remove(self, token: str) -> None:
        self._store.write(lambda t: t.analyses.delete(token))
        self.folder(token).remove()


# Files are created on request, one at a time: printing a plot takes a second.

MOST_WAIT_S = 30.0
MOST_WAITING_FILES = 3
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
        self._places = threading.BoundedSemaphore(1 + MOST_WAITING_FILES)
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
        from slamhive.services.analysis import Printing, file_name, report_page, table_file, zipped  # noqa: PLC0415

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
