"""How the list of runs is drawn, apart from what it lists: pinned columns, colours by value, sparklines."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from werkzeug.datastructures import MultiDict

from slamhive.domain.list_look import MOST_PINNED
from slamhive.errors import InvalidInput
from slamhive.input_bounds import whole_number
from slamhive.store.records import SavedSearchRecord


@dataclass(frozen=True, slots=True)
class Look:
    """The first ``pinned`` columns stay in view when the table is scrolled sideways.

    ``colours`` gives metrics a background by their value. ``sparks`` shows the error of each run over time, or the
    repeats of each configuration.
    """

    pinned: int = 0
    colours: bool = False
    sparks: bool = False

    @classmethod
    def from_args(cls, args: MultiDict[str, str]) -> Look:
        """Read an address; raises InvalidInput naming the invalid value."""
        text = args.get("pinned", "").strip()
        pinned = whole_number(text, "pinned", 0, MOST_PINNED) if text else 0
        return cls(pinned, _chosen(args, "colours"), _chosen(args, "sparks"))

    @classmethod
    def of(cls, saved: SavedSearchRecord) -> Look:
        """The look of a saved search."""
        return cls(saved.pinned, saved.colours, saved.sparks)

    def args(self) -> dict[str, Any]:
        """The arguments of an address, without defaults."""
        pinned = {"pinned": [str(self.pinned)]} if self.pinned else {}
        chosen = {"colours": self.colours, "sparks": self.sparks}
        return pinned | {name: ["yes"] for name, value in chosen.items() if value}


def _chosen(args: MultiDict[str, str], name: str) -> bool:
    text = args.get(name, "").strip()
    if text not in {"", "yes", "no"}:
        raise InvalidInput(f"{name}={text[:40]!r} is not known", "use yes or no")
    return text == "yes"
