"""The runs that nodes may ask about: what each of them may read and write, and the hash of its token.

``<data>/node-runs/<hash of the key>.json`` holds one run from its start until its results were collected. So any
process of the data root can register a run, and a restarted server knows it.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import secrets
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from slamhive.base.clock import utc_now
from slamhive.base.errors import InvalidInput, Unavailable
from slamhive.base.files import write_aside
from slamhive.executors.node_store.on_node.cache import Item
from slamhive.executors.node_store.on_node.connection import OVER
from slamhive.executors.spec import RunOutput

_FOLDER = "node-runs"
_NODE_FOLDER = "node"
_MARK_DIGITS = 8
_KEPT_S = 7 * 86400.0
_ROOM_FOR_NAMES_BYTES = 4096
"""In an archive: the head of a file, and names of any length."""
_MOST_UNBOUNDED_BYTES = 2**50


@dataclass(frozen=True, slots=True)
class Offered:
    """An item that the node may fetch, and the file on the controller that holds it."""

    path: Path
    item: Item


@dataclass(frozen=True, slots=True)
class Registration:
    """A run that a node may ask about.

    Attributes:
        key: The run.
        work: Its work folder; all that arrives is written below it, or to the places of ``copies``.
        offered: What it may fetch, by name.
        orders: What its node gets when it claims the run: anything that JSON holds.
        copies: {place: file on the controller} of the files that the node keeps up to date there.
        logs: The same for folders with the parts of a capped log.
        most_copy_bytes: No copy may be larger.
        most_result_bytes: Nor may the archive of the results.
    """

    key: str
    work: Path
    offered: dict[str, Offered]
    orders: dict[str, Any]
    copies: dict[str, Path]
    logs: dict[str, Path] = field(default_factory=dict)
    most_copy_bytes: int = 100_000_000
    most_result_bytes: int = _MOST_UNBOUNDED_BYTES

    @property
    def folder(self) -> Path:
        """Where the server keeps what it knows of the run."""
        return node_folder(self.work)

    def item(self, sha256: str) -> Offered | None:
        """Return the offer with this hash."""
        return next((entry for entry in self.offered.values() if entry.item.sha256 == sha256), None)

    @property
    def answer(self) -> dict[str, Any]:
        """Return the answer to a node that claims the run."""
        items = {name: entry.item._asdict() for name, entry in self.offered.items()}
        return {"items": items, "orders": self.orders}


def node_folder(work: Path) -> Path:
    """Where the server keeps what it knows of the run with this work folder."""
    return work / _NODE_FOLDER


def archive_bound(outputs: tuple[RunOutput, ...]) -> int:
    """The largest archive that holds outputs within their bounds (bytes)."""
    total_bytes = 20_480
    for output in outputs:
        if output.max_bytes is None or output.max_files is None:
            return _MOST_UNBOUNDED_BYTES
        total_bytes += output.max_bytes + (output.max_files + 1) * _ROOM_FOR_NAMES_BYTES
    return total_bytes


class Registrations:
    """All runs of a data root that nodes may ask about."""

    def __init__(self, data: Path) -> None:
        self._folder = data / _FOLDER

    def add(self, registration: Registration) -> str:
        """Register a run, again if it was; the token, which is kept nowhere. Earlier tokens of the run are void."""
        token = secrets.token_urlsafe(32)
        registration.folder.mkdir(parents=True, exist_ok=True)
        self._folder.mkdir(parents=True, mode=0o700, exist_ok=True)
        content = {"token_sha256": _hash(token), **asdict(registration)}
        content["offered"] = {
            name: {"path": entry.path, "item": entry.item._asdict()} for name, entry in registration.offered.items()
        }
        write_aside(self._path(registration.key), json.dumps(content, default=str), 0o600)
        return token

    def find(self, key: str, token: str) -> Registration | None:
        """The run, if ``token`` is the newest that was made for it. Raises Unavailable without the data root."""
        if not self._folder.parent.is_dir():
            raise Unavailable(f"{self._folder.parent} is not there", "mount the data root")
        content = self._read(key)
        if not _matches(content, token) or content is None or OVER in content:
            return None
        del content["token_sha256"]
        offered = {
            name: Offered(Path(entry["path"]), Item.of(entry["item"])) for name, entry in content["offered"].items()
        }
        paths = {name: {place: Path(path) for place, path in content[name].items()} for name in ("copies", "logs")}
        return Registration(**{**content, "work": Path(content["work"]), "offered": offered, **paths})

    def mark(self, key: str) -> str | None:
        """Names the newest token of a run without giving it away; None if there was none, or long ago."""
        content = self._read(key)
        return None if content is None else str(content["token_sha256"])[:_MARK_DIGITS]

    def was_for(self, key: str, token: str) -> bool:
        """Return whether ``token`` was the last one of a run that is over, so that its node can remove what it has."""
        content = self._read(key)
        return content is not None and OVER in content and _matches(content, token)

    def remove(self, key: str) -> None:
        """The token is void from now on. Does nothing if the run is not registered."""
        content = self._read(key)
        if content is not None and OVER not in content:
            over = {"key": key, OVER: True, "token_sha256": content["token_sha256"]}
            write_aside(self._path(key), json.dumps(over), 0o600)

    def sweep(self) -> None:
        """Remove the records of runs that have been over for a week."""
        for path in self._folder.glob("*.json"):
            if OVER in (_load(path) or {}) and utc_now().timestamp() - path.stat().st_mtime > _KEPT_S:
                path.unlink(missing_ok=True)

    def keys(self) -> set[str]:
        """The runs that are not over."""
        found = [content for path in self._folder.glob("*.json") if (content := _load(path)) is not None]
        return {str(content["key"]) for content in found if OVER not in content}

    def offered_files(self) -> set[Path]:
        """The files that registered runs may still fetch."""
        found = set()
        for path in self._folder.glob("*.json"):
            content = _load(path) or {}
            found |= {Path(entry["path"]) for entry in content.get("offered", {}).values()}
        return found

    def _read(self, key: str) -> dict[str, Any] | None:
        return _load(self._path(key))

    def _path(self, key: str) -> Path:
        return self._folder / f"{_hash(key)}.json"


def copied_place(registration: Registration, place: str) -> Path:
    """Where the copy of ``place`` lies. Raises InvalidInput for a place that the run does not have."""
    if place in registration.copies:
        return registration.copies[place]
    folder, _, name = place.rpartition("/")
    part = name.removeprefix("part-")
    if folder in registration.logs and (name in ("head", "left-out") or (part != name and _is_number(part))):
        return registration.logs[folder] / name
    raise InvalidInput(f"the run has no file {place[:80]!r}")


def _matches(content: dict[str, Any] | None, token: str) -> bool:
    """Compared also without a run, so that the time shows nothing."""
    known = _hash("") if content is None else str(content["token_sha256"])
    return hmac.compare_digest(known, _hash(token)) and content is not None


def _is_number(text: str) -> bool:
    return text.isascii() and text.isdecimal() and len(text) <= 9


def _load(path: Path) -> dict[str, Any] | None:
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    return content


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode(errors="surrogatepass")).hexdigest()
