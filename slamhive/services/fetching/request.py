"""What to fetch, and what that takes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from collections.abc import Sequence as Sequences
from dataclasses import dataclass, field
from pathlib import Path

from slamhive.domain.collection import Collection, FileKind, Need, NeedKind, Part, RemoteFile, Sequence
from slamhive.errors import InvalidInput
from slamhive.fetch.links import Link
from slamhive.fetch.web import Token


@dataclass(frozen=True, slots=True)
class FetchRequest:
    """What a user asks for.

    Attributes:
        sequences: ``COLLECTION/SEQUENCE``, where ``*`` and ``?`` may stand in the second part.
        source: The way to get them, None for the first.
        archives: Files that were downloaded by hand.
        name: The name of the dataset, None for ``COLLECTION_SEQUENCE``; only for a single sequence.
        keep_archive: Leave what was downloaded in the data root.
        accept_licence: The user has read and accepts the licence.
    """

    sequences: tuple[str, ...]
    source: str | None = None
    archives: tuple[Path, ...] = ()
    name: str | None = None
    keep_archive: bool = False
    accept_licence: bool = False


@dataclass(frozen=True, slots=True)
class FetchPlan:
    """One sequence, as it will be fetched. ``by_hand``: files by the name of the remote file that they are."""

    collection: Collection
    sequence: Sequence
    name: str
    parts: tuple[Part, ...]
    token: Token | None = None
    by_hand: dict[str, Path] = field(default_factory=dict)

    @property
    def files(self) -> tuple[RemoteFile, ...]:
        """The files that its parts come from, each once."""
        return tuple({part.file.name: part.file for part in self.parts}.values())

    @property
    def download_bytes(self) -> int | None:
        """How much has to be downloaded, None if a size is unknown."""
        sizes = [file.estimate_bytes for file in self.files if file.name not in self.by_hand]
        return None if None in sizes else sum(size for size in sizes if size is not None)


def check_needs(collection: Collection, request: FetchRequest, missing: Sequences[Need]) -> None:
    """Raise InvalidInput that says what to do if something stands between the user and the files."""
    name = collection.title
    if collection.by_hand and not request.archives:
        need = collection.by_hand[0]
        raise InvalidInput(
            f"{name} cannot be downloaded by a program ({need.kind}). {need.text} {need.address}",
            "then run this command again with --archive FILE for each file",
        )
    if request.archives:
        return
    for need in collection.needs:
        if need.kind is NeedKind.LICENCE and not request.accept_licence:
            raise InvalidInput(
                f"{name} has a licence to accept ({collection.licence}). {need.text} {need.address}",
                "then run this command again with --accept-licence",
            )
    for need in missing:
        raise InvalidInput(
            f"{name} needs an access token. {need.text} {need.address}", f"then set {need.variable}=TOKEN"
        )


def parts_by_hand(sequence: Sequence, parts: tuple[Part, ...], archives: Sequences[Path]) -> dict[str, Path]:
    """The files that were downloaded by hand, by the name of the remote file that each is; their own without parts.

    Raises InvalidInput naming the files that are expected.
    """
    for path in archives:
        if not path.is_file():
            raise InvalidInput(
                f"{path} is no file", "give the downloaded file; a folder is for slamhive dataset import"
            )
    names = list(dict.fromkeys(part.file.name for part in parts))
    if len(names) == len(archives) == 1:
        return {names[0]: archives[0]}
    found = {path.name: path for path in archives}
    strange = [name for name in found if names and name not in names]
    if strange:
        raise InvalidInput(f"{sequence.full_name} has no file {strange[0]}", f"its files are {', '.join(names)}")
    return found


def check_unpackable(parts: tuple[Part, ...], sequence: Sequence, importer: str) -> None:
    """Raise InvalidInput if a file is of a kind that is not unpacked here."""
    for part in parts:
        inner = FileKind.SEVEN_ZIP if part.take.endswith(".7z") and part.unpack else part.file.kind
        if inner is FileKind.SEVEN_ZIP:
            raise InvalidInput(
                f"{sequence.full_name} is packed with 7z, which SLAM Hive does not unpack",
                f"download {part.file.addresses[0]}, unpack it by hand (7z x), "
                f"and run slamhive dataset import FOLDER --format {importer}",
            )


def tokens_of(collection: Collection, environment: Mapping[str, str]) -> tuple[Token | None, tuple[Need, ...]]:
    """The token for the files of a collection, None without; and the needs whose variable is not set."""
    wanted = [need for need in collection.needs if need.kind is NeedKind.TOKEN]
    missing = tuple(need for need in wanted if not environment.get(need.variable))
    given = [need for need in wanted if need not in missing]
    return (Token(given[0].host, environment[given[0].variable]) if given else None), missing


def links_of(collections: Iterable[Collection], environment: Mapping[str, str]) -> list[Link]:
    """Every address of every file, each once."""
    links: dict[str, Link] = {}
    for collection in collections:
        token, _ = tokens_of(collection, environment)
        for file in collection.files:
            for address in file.addresses:
                links.setdefault(address, Link(address, file, token))
    return list(links.values())
