"""The synthetic dataset ``room``: a textured indoor world, the sensors in it, and the bag they record.

World, motion and sensor models need numpy and OpenCV alone, so that an image build can render views with little
installed. Writing the dataset needs more, and is loaded when asked for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from slamhive.recordings.room.dataset import RoomOptions, render_room


def __getattr__(name: str) -> Any:
    if name == "RoomOptions":
        from slamhive.recordings.room.dataset import RoomOptions  # noqa: PLC0415

        return RoomOptions
    if name == "render_room":
        from slamhive.recordings.room.dataset import render_room  # noqa: PLC0415

        return render_room
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
