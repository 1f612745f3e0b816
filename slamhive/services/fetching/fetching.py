"""From an address to a dataset: download, check, unpack, import, clean up."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from collections.abc import Sequence as Sequences
from dataclasses import replace
from pathlib import Path, PurePosixPath

from slamhive.bags.importing import ImportOptions
from slamhive.catalogue.collection_file import kind_of
from slamhive.domain.collection import FileKind, Part, RemoteFile, Sequence
from slamhive.domain.dataset import Dataset
from slamhive.domain.names import check_name
from slamhive.errors import Conflict, InvalidInput, Unavailable
from slamhive.fetch.download import Pace, check_file, check_space, download
from slamhive.fetch.links import Link, check_links
from slamhive.fetch.speed import Speed
from slamhive.fetch.unpack import Choice, unpack
from slamhive.fetch.web import Timeouts
from slamhive.files import TEMPORARY, remedy_of, sweep_folder, temporary_folder
from slamhive.schema.collection import LinkReport, PublicSequence, public_sequence
from slamhive.services.datasets import Catalogue, check_writable
from slamhive.services.fetching.collections import Collections
from slamhive.services.fetching.request import (
    FetchPlan,
    FetchRequest,
    check_needs,
    check_unpackable,
    links_of,
    parts_by_hand,
    tokens_of,
)
from slamhive.settings import Settings

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
        """What ``request`` means, checked as far as possible without the net.

        Raises:
            NotFound: Nothing has that name; there is no such source.
            Conflict: A dataset exists already.
            InvalidInput: Something has to be done by hand before; the message says what.
        """
        check_writable(self._settings)
        sequences = [entry for text in request.sequences for entry in self.collections.named(text)]
        if len(sequences) > 1 and (request.name is not None or request.archives):
            raise InvalidInput("--name and --archive are for a single sequence", "fetch one after the other")
        return tuple(
            self._plan_one(entry, request) for entry in {entry.full_name: entry for entry in sequences}.values()
        )

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

    def links(self, names: Sequences[str] = ()) -> list[Link]:
        """Every address of the collections called ``names``, or of all."""
        chosen = [self.collections.collection(name) for name in names] or self.collections.all
        return links_of(chosen, self._environment)

    def check_links(
        self,
        names: Sequences[str] = (),
        timeouts: Timeouts | None = None,
        connections: int = 8,
        checked: Callable[[int], None] = lambda _count: None,
    ) -> list[LinkReport]:
        """Ask every address of :meth:`links`; ``checked`` is called with the number of those that are done."""
        reports = check_links(self.links(names), timeouts or Timeouts(), connections, checked)
        return [LinkReport.of(report) for report in reports]

    @property
    def folder(self) -> Path:
        """Where downloads lie until they are imported."""
        return self._settings.data / "downloads"

    def _plan_one(self, sequence: Sequence, request: FetchRequest) -> FetchPlan:
        from slamhive.bags.importers import IMPORTERS  # noqa: PLC0415 - some thirty modules

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
        return FetchPlan(collection, sequence, name, parts, token, by_hand)

    def _make(self, plan: FetchPlan, progress: Progress) -> Dataset:
        paths = self._download_all(plan, progress)
        with temporary_folder(root=self._own_folder(plan)) as folder:
            for number, part in enumerate(plan.parts):
                done = _DOWNLOADED + (_UNPACKED - _DOWNLOADED) * number / len(plan.parts)
                take(part, paths[part.file.name], folder, lambda text, done=done: progress(done, text))  # type: ignore[misc]
            return self._import(plan, folder, lambda share, text: progress(_UNPACKED + (1 - _UNPACKED) * share, text))

    def _download_all(self, plan: FetchPlan, progress: Progress) -> dict[str, Path]:
        """The files of a plan by name; those that were downloaded by hand stay where they are."""
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
        return paths

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

    def _import(self, plan: FetchPlan, folder: Path, progress: Progress) -> Dataset:
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
        return self._catalogue.import_dataset(replace(planned, plan=replace(planned.plan, text=text)), progress)

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
        _unpack(part, path, folder, Choice(part.take, part.to), tell)
        return
    with temporary_folder(root=folder.parent) as aside:
        inner = aside / PurePosixPath(part.take).name
        _unpack(part, path, aside, Choice(part.take, inner.name), tell)
        if not inner.exists():
            return
        unpack(inner, kind_of(inner.name), folder, Choice("", part.to))


def _unpack(part: Part, path: Path, folder: Path, choice: Choice, tell: Callable[[str], None]) -> None:
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
