"""Public collections of recordings: where their sequences can be downloaded, and under which conditions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

from slamhive.base.errors import lacks
from slamhive.domain.sensors import SensorKind, SensorSetup, setups_of


class FileKind(StrEnum):
    """Format for unpacking a downloaded file; ``tar`` with any compression."""

    ZIP = "zip"
    TAR = "tar"
    SEVEN_ZIP = "7z"
    PLAIN = "file"


class NeedKind(StrEnum):
    """Obstacle between a user and a download."""

    LICENCE = "licence"
    TOKEN = "token"  # noqa: S105 - the kind, not a secret
    ACCOUNT = "account"
    FORM = "form"


BY_HAND = frozenset({NeedKind.ACCOUNT, NeedKind.FORM})
"""What only a person in a browser can do."""


@dataclass(frozen=True, slots=True)
class Need:
    """A condition of a download.

    ``text`` says what to do, ``address`` where. A token is read from the environment variable ``variable`` and sent to
    ``host`` only.
    """

    kind: NeedKind
    text: str
    address: str = ""
    variable: str = ""
    host: str = ""


@dataclass(frozen=True, slots=True)
class RemoteFile:
    """A file that can be downloaded.

    ``name`` is its local name. The first of ``addresses`` is the original, the others are mirrors. ``size_bytes`` and
    ``checksum`` (``sha256:...``, ``md5:...``) are None if they are not published; ``about_bytes`` is a rounded size.
    """

    name: str
    addresses: tuple[str, ...]
    kind: FileKind
    size_bytes: int | None = None
    about_bytes: int | None = None
    checksum: str | None = None

    @property
    def estimate_bytes(self) -> int | None:
        """The size, or the rounded one; None if neither is known."""
        return self.about_bytes if self.size_bytes is None else self.size_bytes


@dataclass(frozen=True, slots=True)
class Part:
    """Part of a file that a sequence takes.

    ``take`` is a file or folder in the archive (empty: everything), and becomes ``to`` in the folder of the sequence
    (empty: the folder itself). ``unpack``: what is taken is an archive again. An ``optional`` part may be missing.
    """

    file: RemoteFile
    take: str = ""
    to: str = ""
    unpack: bool = False
    optional: bool = False


@dataclass(frozen=True, slots=True)
class Sequence:
    """One recording of a collection.

    ``sources`` are the ways to get it by name, each with its parts; there are none if all must be done by hand.
    ``path`` is what the importer reads below the folder of the sequence. ``uncertainty_m`` is the standard deviation of
    true positions along each axis, None if nothing is published.
    """

    collection: str
    name: str
    attributes: tuple[str, ...]
    sensors: Mapping[SensorKind, int]
    sources: Mapping[str, tuple[Part, ...]]
    path: str
    groundtruth: bool
    uncertainty_m: float | None = None

    @property
    def full_name(self) -> str:
        """``euroc/MH_01_easy``."""
        return f"{self.collection}/{self.name}"

    @property
    def dataset_name(self) -> str:
        """Name of the dataset unless the user chooses another."""
        return f"{self.collection}_{self.name}"

    @property
    def setups(self) -> tuple[SensorSetup, ...]:
        """The sensor set-ups that it can serve."""
        return setups_of(self.sensors)

    @property
    def parts(self) -> tuple[Part, ...]:
        """The parts of the first source."""
        return next(iter(self.sources.values()), ())

    def source(self, name: str | None) -> tuple[Part, ...]:
        """The parts of a source, of the first without a name; raises NotFound."""
        if name is None:
            return self.parts
        if name not in self.sources:
            raise lacks(self.full_name, "source", name, list(self.sources))
        return self.sources[name]


@dataclass(frozen=True, slots=True)
class Collection:
    """A public collection. ``importer`` and ``options`` say how its sequences become datasets."""

    name: str
    title: str
    homepage: str
    licence: str
    citation: str
    importer: str
    options: Mapping[str, str]
    needs: tuple[Need, ...]
    unverified: bool
    note: str
    sequences: tuple[Sequence, ...]

    @property
    def by_hand(self) -> tuple[Need, ...]:
        """Steps to take in a browser before files can be downloaded."""
        return tuple(need for need in self.needs if need.kind in BY_HAND)

    @property
    def files(self) -> tuple[RemoteFile, ...]:
        """Every file of every source, each once."""
        parts = (part for sequence in self.sequences for parts in sequence.sources.values() for part in parts)
        return tuple({part.file.addresses: part.file for part in parts}.values())

    def sharing(self, file: RemoteFile) -> int:
        """Count the sequences that take a part of ``file``."""
        users = Counter(
            part.file.addresses
            for sequence in self.sequences
            for part in {part.file.addresses: part for parts in sequence.sources.values() for part in parts}.values()
        )
        return users[file.addresses]

    def sequence(self, name: str) -> Sequence:
        """The sequence called ``name``; raises NotFound."""
        for sequence in self.sequences:
            if sequence.name == name:
                return sequence
        raise lacks(f"collection {self.name}", "sequence", name, [sequence.name for sequence in self.sequences])
