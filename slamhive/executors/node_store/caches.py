"""Reports of nodes on their caches: ``<data>/node-caches/<hash of the name>.json`` for each."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

from slamhive.executors.nodes import CacheUse
from slamhive.files import write_aside

_MOST_BYTES = 2**62


class NodeCaches:
    """The caches of the nodes of a data root."""

    def __init__(self, data: Path) -> None:
        self._folder = data / "node-caches"

    def note(self, node: str, used_bytes: object, limit_bytes: object) -> None:
        """Keep what a node said; nothing that makes no sense. Raises Unavailable."""
        if not (node and _is_size(used_bytes) and _is_size(limit_bytes)):
            return
        self._folder.mkdir(exist_ok=True)
        content = {"node": node, "used_bytes": used_bytes, "limit_bytes": limit_bytes}
        name = hashlib.sha256(node.encode(errors="surrogatepass")).hexdigest()
        write_aside(self._folder / f"{name}.json", json.dumps(content))

    def all(self) -> dict[str, CacheUse]:
        """By the names of the nodes."""
        found = [json.loads(path.read_text(encoding="utf-8")) for path in self._folder.glob("*.json")]
        return {entry["node"]: CacheUse(entry["used_bytes"], entry["limit_bytes"]) for entry in found}


def _is_size(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= _MOST_BYTES
