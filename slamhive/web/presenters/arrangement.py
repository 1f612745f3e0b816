"""The columns that the list of runs shows, with the addresses that move and pin each of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from urllib.parse import quote

from slamhive.domain.list_look import MOST_PINNED
from slamhive.web.columns import Column


@dataclass(frozen=True, slots=True)
class Arranged:
    """One column. ``left`` and ``right`` are None where the column cannot move further.

    ``pin`` pins the columns up to this one; on the last pinned column, it unpins all.
    """

    column: Column
    left: str | None
    right: str | None
    pin: str
    pinned: bool
    last_pinned: bool


def arranged(base: str, columns: Sequence[Column], pinned: int) -> list[Arranged]:
    """The columns in order. ``base`` is the address of the list with all arguments but ``columns`` and ``pinned``.

    It is made once and the links are appended to it, because Flask takes longer for each address than a row takes.
    """
    keys = [column.key for column in columns]

    def link(name: str, key: str, order: Sequence[str], count: int) -> str:
        kept = f"&pinned={count}" if count else ""
        return f"{base}&columns={quote(','.join(order), safe=',')}{kept}#{name}-{quote(key)}"

    def moved(name: str, place: int, by: int) -> str | None:
        if not 0 <= place + by < len(keys):
            return None
        order = keys.copy()
        order.insert(place + by, order.pop(place))
        return link(name, keys[place], order, pinned)

    return [
        Arranged(
            column,
            left=moved("left", place, -1),
            right=moved("right", place, 1),
            pin=link("pin", column.key, keys, 0 if place + 1 == pinned else min(place + 1, MOST_PINNED)),
            pinned=place < pinned,
            last_pinned=place + 1 == pinned,
        )
        for place, column in enumerate(columns)
    ]
