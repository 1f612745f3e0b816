"""Stored analyses: create, list, read and remove them. :mod:`slamhive.services.analyses.jobs` computes them."""

from __future__ import annotations

import re
import secrets
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

from slamhive.clock import utc_now
from slamhive.domain.visibility import Visibility
from slamhive.errors import Forbidden, InvalidInput, NotFound, SlamHiveError, Unavailable
from slamhive.services.analyses.folder import AnalysisFolder
from slamhive.services.datasets import check_writable
from slamhive.settings import Mode, Settings
from slamhive.store import Store
from slamhive.store.analysis_records import AnalysisRecord, AnalysisState

MAX_TEXT_BYTES = 100_000
"""Parsing YAML of this size takes about a second, the limit for a request; ``slamhive analyse`` takes larger files."""
MOST_WAITING = 50
_TOKEN = re.compile(r"[0-9a-f]{32}")


def may_analyse(settings: Settings) -> bool:
    """Whether the installation accepts new analyses; in view-only mode they come from visitors and are not listed."""
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
        """Whether a text looks like the token of an analysis."""
        return _TOKEN.fullmatch(text) is not None

    def listed(self, limit: int = 500) -> list[AnalysisRecord]:
        """The listed analyses, newest first."""
        return self._store.read(lambda t: t.analyses.listed(limit))

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
