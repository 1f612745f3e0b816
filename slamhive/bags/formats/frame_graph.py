"""Where frames are relative to each other: rigid transforms between pairs of them, joined along the shortest path."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

import numpy as np

from slamhive.bags.geometry import Array


class FrameGraph:
    """Frames by name, and the transforms between them that are known."""

    def __init__(self) -> None:
        self._neighbours: dict[str, dict[str, Array]] = {}

    def add(self, parent: str, child: str, T_parent_child: Array) -> None:
        """Add ``T_parent_child`` (4, 4); the first one that is known of a pair counts."""
        if child not in self._neighbours.get(parent, {}):
            self._neighbours.setdefault(parent, {})[child] = T_parent_child
            self._neighbours.setdefault(child, {})[parent] = inverse(T_parent_child)

    def edges(self) -> Iterator[tuple[str, str, Array]]:
        """All transforms: parent, child, ``T_parent_child`` (4, 4); each pair in both directions."""
        for parent, children in self._neighbours.items():
            for child, T_parent_child in children.items():
                yield parent, child, T_parent_child

    def __contains__(self, frame: str) -> bool:
        return frame in self._neighbours

    def find(self, parent: str, child: str) -> Array | None:
        """``T_parent_child`` (4, 4), or None if nothing connects the two."""
        found = {parent: np.eye(4)}
        waiting = deque([parent])
        while waiting and child not in found:
            frame = waiting.popleft()
            for other, T_frame_other in self._neighbours.get(frame, {}).items():
                if other not in found:
                    found[other] = found[frame] @ T_frame_other
                    waiting.append(other)
        return found.get(child)


def inverse(T: Array) -> Array:
    """The inverse of a rigid transform (4, 4)."""
    R, t = T[:3, :3], T[:3, 3]
    result = np.eye(4)
    result[:3, :3] = R.T
    result[:3, 3] = -R.T @ t
    return result
