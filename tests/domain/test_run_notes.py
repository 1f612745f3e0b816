"""Notes and tags: what is kept, what a change does, what is refused."""

import pytest

from slamhive.base.errors import InvalidInput
from slamhive.domain.run import MOST_TAGS, NO_NOTES, NotesChange, RunNotes, split_tags


def test_a_change_keeps_what_it_does_not_name():
    notes = NotesChange("a note", add=("b", "a", "b")).applied(NO_NOTES)
    assert notes == RunNotes("a note", ("a", "b"))
    assert NotesChange(add=("c",), remove=("a",)).applied(notes) == RunNotes("a note", ("b", "c"))
    assert NotesChange("").applied(notes) == RunNotes("", ("a", "b"))
    assert not NotesChange("  \r\n", remove=("a", "b")).applied(notes)


def test_notes_come_back_from_their_file():
    notes = RunNotes("two\nlines", ("x", "y.1"))
    assert RunNotes.of(notes.content) == notes
    assert RunNotes.of({}) == NO_NOTES


@pytest.mark.parametrize(
    "content",
    [
        {"note": 1},
        {"tags": "paper"},
        {"tags": [1]},
        {"tags": ["two words"]},
        {"tags": ["-x"]},
        {"tags": ["x" * 65]},
        {"tags": [str(n) for n in range(MOST_TAGS + 1)]},
        {"note": "x" * 10_001},
    ],
)
def test_what_cannot_be_kept_is_refused(content):
    with pytest.raises(InvalidInput):
        RunNotes.of(content)


def test_tags_are_split_at_spaces_and_commas():
    assert split_tags(" a, b  c,,a\n") == ("a", "b", "c")
