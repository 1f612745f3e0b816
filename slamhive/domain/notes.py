"""What people write about a run: a note and tags."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from slamhive.errors import InvalidInput

LONGEST_NOTE = 10_000
LONGEST_TAG = 64
MOST_TAGS = 20
_TAG = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")


@dataclass(frozen=True, slots=True)
class RunNotes:
    """The note of a run, empty for none, and its tags in order."""

    note: str = ""
    tags: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.note or self.tags)

    @property
    def content(self) -> dict[str, Any]:
        """As JSON."""
        return {"note": self.note, "tags": list(self.tags)}

    @classmethod
    def of(cls, content: Mapping[str, Any]) -> RunNotes:
        """From :attr:`content`, which anybody may have edited; raises InvalidInput."""
        note, tags = content.get("note", ""), content.get("tags", [])
        if not isinstance(note, str) or not isinstance(tags, list) or not all(isinstance(tag, str) for tag in tags):
            raise InvalidInput("a note is a text, and tags are a list of texts")
        return checked_notes(note, tags)


NO_NOTES = RunNotes()


@dataclass(frozen=True, slots=True)
class NotesChange:
    """A change: a new ``note`` (None keeps it), tags to ``add``, and tags to ``remove``."""

    note: str | None = None
    add: tuple[str, ...] = ()
    remove: tuple[str, ...] = ()

    def applied(self, notes: RunNotes) -> RunNotes:
        """The notes after the change; raises InvalidInput for what cannot be kept."""
        kept = [tag for tag in notes.tags if tag not in self.remove]
        changed = checked_notes(notes.note if self.note is None else self.note, [*kept, *self.add])
        return replace(changed, tags=tuple(sorted(changed.tags)))


def checked_notes(note: str, tags: list[str]) -> RunNotes:
    """The notes; raises InvalidInput naming what cannot be kept."""
    text = note.replace("\r\n", "\n").strip()
    if len(text) > LONGEST_NOTE:
        raise InvalidInput(f"the note has {len(text)} characters", f"use at most {LONGEST_NOTE}")
    for tag in tags:
        if len(tag) > LONGEST_TAG or not _TAG.fullmatch(tag):
            remedy = f"use at most {LONGEST_TAG} letters, digits, '_', '.' and '-', the first a letter or digit"
            raise InvalidInput(f"{tag[:80]!r} is not a tag", remedy)
    own = tuple(dict.fromkeys(tags))
    if len(own) > MOST_TAGS:
        raise InvalidInput(f"{len(own)} tags are too many", f"use at most {MOST_TAGS} for each run")
    return RunNotes(text, own)


def split_tags(text: str) -> tuple[str, ...]:
    """The tags in a text with spaces or commas between them."""
    return tuple(dict.fromkeys(part for part in re.split(r"[\s,]+", text) if part))
