"""The buttons of the editor of analyses that change the plots of its text: insert, edit, replace, move, remove."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from slamhive.errors import InvalidInput, unknown
from slamhive.web.analysis_builder import Card, Form, entry_of
from slamhive.web.analysis_entries import (
    Entry,
    entries,
    find_entry,
    moved_entry,
    replaced_entry,
    with_entry,
    without_entry,
)


@dataclass(frozen=True, slots=True)
class Changed:
    """The text after a change, what was done, and the plot whose choices its card should show."""

    text: str
    notice: str
    editing: Entry | None = None


class Changes:
    """What the buttons do. A button sends a verb, a colon, and what it is about: a plot type, a number, or both.

    Args:
        text: Of the editor.
        cards: The cards beside it; asked for when a change needs them.
        form: What the page has sent with the button.
    """

    def __init__(self, text: str, cards: Callable[[], Sequence[Card]], form: Form) -> None:
        self._text = text
        self._cards = cards
        self._form = form
        self._verbs: dict[str, Callable[[str], Changed]] = {
            "insert": self._insert,
            "edit": self._edit,
            "replace": self._replace,
            "remove": self._remove,
            "earlier": lambda what: self._move(what, -1),
            "later": lambda what: self._move(what, 1),
        }

    def made(self, button: str) -> Changed | None:
        """The change of one button; None for other buttons. Raises NotFound, InvalidInput."""
        verb, _, what = button.partition(":")
        change = self._verbs.get(verb)
        return None if change is None else change(what)

    def _insert(self, key: str) -> Changed:
        longer = with_entry(self._text, entry_of(self._card(key), self._form))
        return Changed(longer, f"Plot {len(entries(longer))} was added: {key}.")

    def _edit(self, number: str) -> Changed:
        entry = find_entry(self._text, _number(number))
        self._card(entry.key)
        return Changed(self._text, f"Change plot {number} under {entry.key}, then replace it.", entry)

    def _replace(self, what: str) -> Changed:
        number, _, key = what.partition(":")
        before, card = find_entry(self._text, _number(number)), self._card(key)
        written = entry_of(card, self._form)
        if before.key == key:  # what has no field stays
            fields = {field.option for field in card.fields}
            written = {**{name: value for name, value in before.content.items() if name not in fields}, **written}
        return Changed(replaced_entry(self._text, before.number, written), f"Plot {number} was changed: {key}.")

    def _remove(self, number: str) -> Changed:
        return Changed(without_entry(self._text, _number(number)), f"Plot {number} was removed.")

    def _move(self, number: str, steps: int) -> Changed:
        place = _number(number)
        return Changed(moved_entry(self._text, place, steps), f"Plot {place} is now plot {place + steps}.")

    def _card(self, key: str) -> Card:
        known = {card.key: card for card in self._cards()}
        if key not in known:
            raise unknown("plot type", key, list(known))
        return known[key]


def _number(text: str) -> int:
    if not (text.isascii() and text.isdecimal() and len(text) <= 9):
        raise InvalidInput(f"{text[:40]!r} is not the number of a plot")
    return int(text)
