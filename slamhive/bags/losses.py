"""Messages that an import leaves out although the recording has them, or says that it has them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Self

from slamhive.errors import InvalidInput

MOST_LOST = 0.01
"""The share of the messages of a sensor above which a loss is an error: the rest is not what was recorded."""


class Loss(str):
    """A note that says why ``lost`` of ``total`` messages are left out; it is an error above :data:`MOST_LOST`."""

    __slots__ = ("lost", "total")

    lost: int
    total: int

    def __new__(cls, lost: int, total: int, note: str) -> Self:
        """A loss whose ``note`` is what users read."""
        loss = super().__new__(cls, note)
        loss.lost, loss.total = lost, total
        return loss


def refuse_losses(notes: Iterable[str], *, accepted: bool) -> None:
    """Raise InvalidInput if one of ``notes`` is a loss above :data:`MOST_LOST`, unless the user has accepted it."""
    lost = [note for note in notes if isinstance(note, Loss) and note.lost > MOST_LOST * note.total]
    if lost and not accepted:
        share = max(note.lost / note.total for note in lost)
        raise InvalidInput(
            f"{'; '.join(lost)}: {'' if len(lost) == 1 else 'up to '}{share:.0%} is lost",
            f"complete or correct the recording; --accept-loss imports the rest, above {MOST_LOST:.0%} too",
        )
