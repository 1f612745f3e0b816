"""What a search over everything found, as JSON."""

from __future__ import annotations

from typing import Annotated

from slamhive.domain.finding import FoundKind
from slamhive.schema.fields import described
from slamhive.schema.model import Document


class FoundThing(Document):
    """Something with a name that holds the words."""

    kind: FoundKind
    key: Annotated[str, described("Its number, name or token; for runs, the filter that lists them.")]
    name: str
    words: Annotated[str, described("What is known of it; empty for nothing.")]
