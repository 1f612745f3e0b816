"""Public sequences: the catalogue of collections, checks of addresses, and the way from an address to a dataset."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from collections.abc import Sequence as Sequences
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path, PurePosixPath

from slamhive.base.errors import Conflict, InvalidInput, NotFound, Unavailable, nearest, unknown
from slamhive.base.files import TEMPORARY, remedy_of, sweep_folder, temporary_folder
from slamhive.base.settings import Settings
from slamhive.documents.catalogue import LinkReportDocument, PublicSequence, public_sequence
from slamhive.domain.collection import Collection, FileKind, Need, NeedKind, Part, RemoteFile, Sequence
from slamhive.domain.dataset import Dataset
from slamhive.domain.names import check_name
from slamhive.downloads.download import CheckedLink, Pace, Speed, check_file, check_links, check_space, download
from slamhive.downloads.unpack import MemberChoice, unpack
from slamhive.downloads.web import AccessToken, Timeouts
from slamhive.packages.collection_file import kind_of, load_collection
from slamhive.recordings.importing import ImportOptions
from slamhive.services.datasets import Catalogue, check_writable


@dataclass(frozen=True, slots=True)
class FetchRequest:
    """Request of a user.

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
    token: AccessToken | None = None
    by_hand: dict[str, Path] = field(default_factory=dict)

    @property
    def files(self) -> tuple[RemoteFile, ...]:
        """The files that its parts come from, each once."""
        return tuple({part.file.name: part.file for part in self.parts}.values())

    @property
    def download_bytes(self) -> int | None:
        """Bytes to download, None if a size is unknown."""
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
                f"{path} is not a file", "give the downloaded file; a folder is for slamhive dataset import"
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


def tokens_of(collection: Collection, environment: Mapping[str, str]) -> tuple[AccessToken | None, tuple[Need, ...]]:
    """The token for the files of a collection, None without; and the needs whose variable is not set."""
    wanted = [need for need in collection.needs if need.kind is NeedKind.TOKEN]
    missing = tuple(need for need in wanted if not environment.get(need.variable))
    given = [need for need in wanted if need not in missing]
    return (AccessToken(given[0].host, environment[given[0].variable]) if given else None), missing


def links_of(collections: Iterable[Collection], environment: Mapping[str, str]) -> list[CheckedLink]:
    """Every address of every file, each once."""
    links: dict[str, CheckedLink] = {}
    for collection in collections:
        token, _ = tokens_of(collection, environment)
        for file in collection.files:
            for address in file.addresses:
                links.setdefault(address, CheckedLink(address, file, token))
    return list(links.values())


# The catalogue of public collections.

CATALOGUE_FOLDER = Path("datasets") / "catalogue"


class Collections:
    """The collections in ``datasets/catalogue`` of the project, read on first use."""

    def __init__(self, project_root: Path) -> None:
        self._folder = project_root / CATALOGUE_FOLDER

    @cached_property
    def all(self) -> tuple[Collection, ...]:
        """Every collection, sorted by name; raises InvalidInput naming the file that cannot be read."""
        return tuple(load_collection(path) for path in sorted(self._folder.glob("*.yaml")))

    def collection(self, name: str) -> Collection:
        """The collection called ``name``; raises NotFound."""
        for collection in self.all:
            if collection.name == name:
                return collection
        raise unknown("collection", name, [entry.name for entry in self.all], "slamhive dataset search lists all")

    def named(self, text: str) -> tuple[Sequence, ...]:
        """The sequences that ``COLLECTION/SEQUENCE`` names, where ``*`` and ``?`` may stand for letters of the second.

        Raises InvalidInput without a slash, and NotFound with the nearest name.
        """
        collection_name, slash, name = text.partition("/")
        if not slash or not name:
            raise InvalidInput(
                f"{text!r} names no sequence",
                "write COLLECTION/SEQUENCE, for instance euroc/MH_01_easy or 'euroc/MH_*'",
            )
        collection = self.collection(collection_name)
        if not set(name) & set("*?"):
            return (collection.sequence(name),)
        found = tuple(entry for entry in collection.sequences if fnmatchcase(entry.name, name.replace("[", "[[]")))
        if not found:
            raise NotFound(f"no sequence of {collection_name} matches {name!r}", "slamhive dataset search lists all")
        return found

    def search(self, words: Sequences[str]) -> tuple[tuple[Collection, Sequence], ...]:
        """The sequences that all ``words`` fit, in the order of the catalogue; all without words.

        A word is an attribute, a sensor set-up, or a part of a name. Raises NotFound for one that fits no sequence.
        """
        found = self._pairs
        for word in (word.lower() for word in words):
            fitting = [pair for pair in self._pairs if self._fits(word, *pair)]
            if not fitting:
                raise NotFound(f"no sequence fits {word!r}; {nearest(word, sorted(self._words))}")
            found = tuple(pair for pair in found if pair in fitting)
        return found

    def _fits(self, word: str, collection: Collection, sequence: Sequence) -> bool:
        if word in self._words:
            return word in sequence.attributes or word in sequence.setups
        return word in sequence.full_name.lower() or word in collection.title.lower()

    @cached_property
    def _words(self) -> frozenset[str]:
        """Every attribute and set-up of any sequence."""
        return frozenset(word for _, entry in self._pairs for word in (*entry.attributes, *map(str, entry.setups)))

    @cached_property
    def _pairs(self) -> tuple[tuple[Collection, Sequence], ...]:
        return tuple((collection, entry) for collection in self.all for entry in collection.sequences)


# Fetching: download, check, unpack, import, clean up.

Progress = Callable[[float, str], None]
"""Called with the fraction done (0..1) and the current activity."""

_DOWNLOADED, _UNPACKED = 0.7, 0.8
_TOLD_BYTES = 10_000_000


class Fetching:
    """Public sequences: find them, check their addresses, make datasets of them.

    Args:
        settings: In force.
        catalogue: Makes the datasets.
        collections: What there is to fetch.
        environment: Holds tokens.
        pace: Of downloads.
    """

    def __init__(
        self,
        settings: Settings,
        catalogue: Catalogue,
        collections: Collections,
        environment: Mapping[str, str] | None = None,
        pace: Pace | None = None,
    ) -> None:
        self._settings = settings
        self._catalogue = catalogue
        self.collections = collections
        self._environment = os.environ if environment is None else environment
        self._pace = pace or Pace()

    def plan(self, request: FetchRequest) -> tuple[FetchPlan, ...]:
        """Resolve ``request``, checked as far as possible without the net.

        Raises:
            NotFound: Nothing has that name; there is no such source.
            Conflict: A dataset exists already.
            InvalidInput: Something has to be done by hand before; the message says what.
        """
        check_writable(self._settings)
        sequences = [entry for text in request.sequences for entry in self.collections.named(text)]
        if len(sequences) > 1 and (request.name is not None or request.archives):
            raise InvalidInput("--name and --archive are for a single sequence", "fetch one after the other")
        from slamhive.recordings.importers.registry import IMPORTERS  # noqa: PLC0415 - some thirty modules

        plans: list[FetchPlan] = []
        for sequence in {entry.full_name: entry for entry in sequences}.values():
            collection = self.collections.collection(sequence.collection)
            token, missing = tokens_of(collection, self._environment)
            check_needs(collection, request, missing)
            parts = sequence.source(request.source)
            IMPORTERS.get(collection.importer)
            check_unpackable(parts, sequence, collection.importer)
            name = check_name("dataset", request.name or sequence.dataset_name)
            if self._catalogue.dataset_folder(name).exists():
                raise Conflict(f"dataset {name!r} exists already", "choose another --name, or remove it first")
            by_hand = parts_by_hand(sequence, parts, request.archives)
            if not parts:
                parts = tuple(Part(RemoteFile(file, (), kind_of(file))) for file in by_hand)
            plans.append(FetchPlan(collection, sequence, name, parts, token, by_hand))
        return tuple(plans)

    def perform(self, plans: tuple[FetchPlan, ...], request: FetchRequest, progress: Progress) -> Iterator[Dataset]:
        """Make one dataset after the other. A file is removed when no later plan needs it, unless it shall be kept."""
        self._sweep()
        for number, plan in enumerate(plans):
            later = {file.name for other in plans[number + 1 :] for file in other.files}

            def tell(fraction: float, text: str, number: int = number, plan: FetchPlan = plan) -> None:
                progress((number + fraction) / len(plans), f"{plan.sequence.full_name}: {text}")

            yield self._make(plan, tell)
            if not request.keep_archive:
                self._remove(plan, later)

    def search(self, words: Sequences[str]) -> list[PublicSequence]:
        """The public sequences that all ``words`` fit; raises NotFound for a word that fits none."""
        return [public_sequence(*pair) for pair in self.collections.search(words)]

    def links(self, names: Sequences[str] = ()) -> list[CheckedLink]:
        """Every address of the collections called ``names``, or of all."""
        chosen = [self.collections.collection(name) for name in names] or self.collections.all
        return links_of(chosen, self._environment)

    def check_links(
        self,
        names: Sequences[str] = (),
        timeouts: Timeouts | None = None,
        connections: int = 8,
        checked: Callable[[int], None] = lambda _count: None,
    ) -> list[LinkReportDocument]:
        """Ask every address of :meth:`links`; ``checked`` is called with the number of those that are done."""
        return check_links(self.links(names), timeouts or Timeouts(), connections, checked)

    @property
    def folder(self) -> Path:
        """Where downloads lie until they are imported."""
        return self._settings.data / "downloads"

    def _make(self, plan: FetchPlan, progress: Progress) -> Dataset:
        self._check_disk(plan)
        paths: dict[str, Path] = {}
        for number, file in enumerate(plan.files):
            if file.name in plan.by_hand:
                paths[file.name] = plan.by_hand[file.name]
                check_file(paths[file.name], file)
                continue
            speed, target = Speed(), self._own_folder(plan) / file.name

            def received(done: int, size: int | None, file: RemoteFile = file, number: int = number) -> None:
                expected = size or file.estimate_bytes
                share = (number + (done / expected if expected else 0.0)) / len(plan.files)
                progress(_DOWNLOADED * min(share, 1.0), f"{file.name}: {speed.words(done, size)}")  # noqa: B023

            download(file, target, self._pace, plan.token, received)
            paths[file.name] = target
        with temporary_folder(root=self._own_folder(plan)) as folder:
            for number, part in enumerate(plan.parts):
                done = _DOWNLOADED + (_UNPACKED - _DOWNLOADED) * number / len(plan.parts)
                take(part, paths[part.file.name], folder, lambda text, done=done: progress(done, text))  # type: ignore[misc]
            collection, sequence = plan.collection, plan.sequence
            planned = self._catalogue.plan_import(
                folder / sequence.path,
                ImportOptions(**collection.options),  # type: ignore[arg-type] # a test holds that they are fields of it
                format_name=collection.importer,
                name=plan.name,
            )
            text = replace(
                planned.plan.text,
                title=f"{collection.title} {sequence.name}",
                licence=collection.licence or planned.plan.text.licence,
                citation=collection.citation,
                source=collection.homepage,
                attributes=tuple(dict.fromkeys((*sequence.attributes, *planned.plan.text.attributes))),
            )
            truth = planned.plan.truth
            if truth is not None and truth.uncertainty_m is None:
                truth = replace(truth, uncertainty_m=sequence.uncertainty_m)
            return self._catalogue.import_dataset(
                replace(planned, plan=replace(planned.plan, text=text, truth=truth)),
                lambda share, text: progress(_UNPACKED + (1 - _UNPACKED) * share, text),
            )

    def _check_disk(self, plan: FetchPlan) -> None:
        """Room for the download, and twice for the share of this sequence: unpacked, and as a dataset."""
        folder = self._own_folder(plan)
        needed = 0.0
        for file in plan.files:
            size = file.estimate_bytes or 0
            there = (folder / file.name).exists() or file.name in plan.by_hand
            needed += (0 if there else size) + 2 * size / max(plan.collection.sharing(file), 1)
        check_space(folder, int(needed), plan.sequence.full_name)

    def _own_folder(self, plan: FetchPlan) -> Path:
        folder = self.folder / plan.collection.name
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise Unavailable(f"{folder} cannot be made: {error.strerror}", remedy_of(error)) from None
        return folder

    def _remove(self, plan: FetchPlan, later: set[str]) -> None:
        folder = self._own_folder(plan)
        for file in plan.files:
            if file.name not in later and file.name not in plan.by_hand:
                (folder / file.name).unlink(missing_ok=True)
        if not any(folder.iterdir()):
            folder.rmdir()

    def _sweep(self) -> None:
        """Remove what killed commands have unpacked."""
        for path in self.folder.glob(f"*/{TEMPORARY}*"):
            sweep_folder(path)


def take(part: Part, path: Path, folder: Path, tell: Callable[[str], None]) -> None:
    """Bring a part into the folder of the sequence; raises InvalidInput if the archive does not hold it."""
    if part.file.kind is FileKind.PLAIN:
        _place(path, folder / (part.to or part.file.name))
        return
    tell(f"unpacking {part.file.name}")
    if not part.unpack:
        _unpack(part, path, folder, MemberChoice(part.take, part.to), tell)
        return
    with temporary_folder(root=folder.parent) as aside:
        inner = aside / PurePosixPath(part.take).name
        _unpack(part, path, aside, MemberChoice(part.take, inner.name), tell)
        if not inner.exists():
            return
        unpack(inner, kind_of(inner.name), folder, MemberChoice("", part.to))


def _unpack(part: Part, path: Path, folder: Path, choice: MemberChoice, tell: Callable[[str], None]) -> None:
    done_bytes = 0

    def room(piece_bytes: int) -> None:
        nonlocal done_bytes
        before, done_bytes = done_bytes, done_bytes + piece_bytes
        if before // _TOLD_BYTES != done_bytes // _TOLD_BYTES:
            tell(f"unpacking {part.file.name}: {done_bytes / 1e6:,.0f} MB")

    files = unpack(path, part.file.kind, folder, choice, room=room)
    if not files and not part.optional:
        raise InvalidInput(f"{path.name} holds no {part.take or 'file'}", "the archive has changed; unpack it by hand")


def _place(path: Path, target: Path) -> None:
    """A second name for a file, or a copy on another disk."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(path, target)
    except OSError:
        try:
            shutil.copyfile(path, target)
        except OSError as error:
            raise Unavailable(f"{target} cannot be written: {error.strerror}", remedy_of(error)) from None
