"""What the store knows about analyses: frozen values, never rows."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum

from slamhive.domain.visibility import Sharing, Visibility


class AnalysisState(StrEnum):
    """Where an analysis is in its life."""

    QUEUED = "queued"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"

    @property
    def ended(self) -> bool:
        """Whether it stays in this state unless somebody computes it again."""
        return self in (AnalysisState.DONE, AnalysisState.FAILED)


@dataclass(frozen=True, slots=True)
class AnalysisRecord:
    """A stored analysis. Its folder is the truth; this is its place in lists and in the queue.

    ``token`` (32 hex digits) is its permanent address and cannot be guessed. A ``visitor`` made it in view-only mode.
    ``content_hash`` identifies what it shows (the text of its file, its runs and their metrics); None until that is
    known. ``reason``: why it failed. ``size_bytes``: the stored report, None while there is none.
    ``owner`` and ``visibility``: see :class:`slamhive.domain.visibility.Sharing`.
    """

    token: str
    name: str
    state: AnalysisState
    listed: bool
    visitor: bool
    created_at: datetime
    content_hash: str | None = None
    reason: str | None = None
    size_bytes: int | None = None
    ended_at: datetime | None = None
    attempt: int = 0
    lease_owner: str | None = None
    owner: str | None = None
    visibility: Visibility | None = None

    @property
    def sharing(self) -> Sharing:
        """Owner and visibility."""
        return Sharing(self.owner, self.visibility)

    @property
    def seen_by(self) -> Visibility:
        """Who sees the analysis besides admins."""
        return self.sharing.seen_by
