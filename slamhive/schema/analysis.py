"""A stored analysis: the state that its folder holds."""

from __future__ import annotations

from typing import Annotated

from slamhive.domain.visibility import Visibility
from slamhive.schema.fields import described
from slamhive.schema.model import Document
from slamhive.schema.types import Moment, cut


class StoredAnalysis(Document):
    """``state.json`` in the folder of an analysis."""

    format: int = 1
    name: Annotated[str, cut(200)]
    state: str
    listed: Annotated[bool, described("Shown in the list of analyses.")]
    visitor: Annotated[bool, described("A visitor of a view-only server made it.")]
    created_at: Moment
    ended_at: Moment | None
    content_hash: Annotated[str | None, described("Identifies its file, runs and metrics; null until known.")]
    reason: Annotated[str | None, described("Why it failed.")]
    owner: Annotated[str | None, described("The account that it belongs to; null for nobody.")] = None
    visibility: Annotated[Visibility | None, described("Who sees it; null for everybody who is signed in.")] = None
