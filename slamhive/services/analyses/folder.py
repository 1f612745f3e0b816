"""The folder of a stored analysis: its file, state and results. The folder is the truth."""

from __future__ import annotations

import contextlib
import gzip
import json
import shutil
import zlib
from pathlib import Path
from typing import Any

from slamhive.errors import InvalidInput, NotFound, Unavailable
from slamhive.files import held_folder, remedy_of, write_aside
from slamhive.input_bounds import read_record
from slamhive.schema.analysis import StoredAnalysis
from slamhive.store.analysis_records import AnalysisRecord, AnalysisState

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
        """Whether all results exist."""
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
