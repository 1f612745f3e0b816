"""``datasets/catalogue/*.yaml`` to :class:`~slamhive.domain.collection.Collection`."""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath
from typing import Annotated, Literal
from urllib.parse import unquote, urlsplit

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from slamhive.base import strict_yaml
from slamhive.base.errors import InvalidInput
from slamhive.documents.model import check_name_in, explained, first_problem
from slamhive.domain.collection import Collection, FileKind, Need, NeedKind, Part, RemoteFile, Sequence
from slamhive.domain.dataset import MOST_UNCERTAIN_M
from slamhive.domain.names import NAME_PATTERN
from slamhive.domain.sensors import SensorKind

_PLACEHOLDER = re.compile(r"\{([a-z_]+)\}")
_CHECKSUM = r"(md5:[0-9a-f]{32}|sha1:[0-9a-f]{40}|sha256:[0-9a-f]{64})"
_ENDINGS = {
    FileKind.ZIP: (".zip",),
    FileKind.TAR: (".tar", ".tgz", ".tar.gz", ".tbz2", ".tar.bz2", ".tar.xz"),
    FileKind.SEVEN_ZIP: (".7z",),
}


def kind_of(name: str) -> FileKind:
    """The kind of a file by the end of its name."""
    for kind, endings in _ENDINGS.items():
        if name.lower().endswith(endings):
            return kind
    return FileKind.PLAIN


def _address(text: str) -> str:
    parts = urlsplit(text)
    if parts.scheme not in ("http", "https") or not parts.hostname or parts.username is not None:
        raise explained(InvalidInput(f"{text!r} is no http or https address without a user name"))
    return text


def _inside(text: str) -> str:
    path = PurePosixPath(text)
    if path.is_absolute() or ".." in path.parts or "\\" in text:
        raise explained(InvalidInput(f"{text!r} is no path inside an archive or folder"))
    return text.strip("/")


Address = Annotated[str, AfterValidator(_address)]
InnerPath = Annotated[str, AfterValidator(_inside)]
Checksum = Annotated[str, Field(pattern=rf"\A{_CHECKSUM}\z")]
Name = Annotated[str, Field(pattern=rf"\A{NAME_PATTERN}\z")]
Size = Annotated[int, Field(gt=0)]
Uncertainty = Annotated[float, Field(gt=0, le=MOST_UNCERTAIN_M)]
Words = list[Annotated[str, Field(pattern=r"\A[a-z0-9][a-z0-9-]{0,40}\z")]]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", defer_build=True)


class NeedModel(_Model):
    """Conditions that must be accepted, and access that must be asked for."""

    kind: NeedKind
    text: str = Field(min_length=1, description="What to do, in one sentence.")
    address: Address | None = None
    variable: str | None = Field(default=None, pattern=r"\A[A-Z][A-Z0-9_]*\z", description="Holds the token.")
    host: str | None = Field(default=None, description="The only host that gets the token.")

    @model_validator(mode="after")
    def _complete(self) -> NeedModel:
        if (self.kind is NeedKind.TOKEN) is not (self.variable is not None and self.host is not None):
            raise explained(InvalidInput("a token, and nothing else, needs variable and host"))
        return self


class FileModel(_Model):
    """A file; ``{sequence}`` and the values of a sequence stand for themselves in texts."""

    address: Address
    mirrors: list[Address] = Field(default_factory=list)
    bytes: Size | None = Field(default=None, description="Exact size, if published.")
    about_bytes: Size | None = Field(default=None, description="Rounded size, if only that is published.")
    checksum: Checksum | None = None
    kind: FileKind | None = Field(default=None, description="If the address does not end with it.")
    name: str | None = Field(default=None, description="Local name, if the address does not end with one.")


class PartModel(_Model):
    """The part of a file that a sequence takes."""

    file: str = Field(description="A key of files.")
    take: InnerPath = Field(default="", description="File or folder in the archive; everything if empty.")
    to: InnerPath = Field(default="", description="What it becomes in the folder of the sequence.")
    unpack: bool = Field(default=False, description="What is taken is an archive again.")
    optional: bool = Field(default=False, description="The archive may lack it.")


class SequenceModel(_Model):
    """Differences of one sequence from the others."""

    values: dict[str, str] = Field(default_factory=dict, description="What placeholders stand for.")
    attributes: Words = Field(default_factory=list)
    sensors: dict[SensorKind, int] | None = Field(default=None, description="Instead of those of the collection.")
    bytes: dict[str, Size] = Field(default_factory=dict, description="Exact size by key of files.")
    checksums: dict[str, Checksum] = Field(default_factory=dict, description="By key of files.")
    sources: list[str] | None = Field(default=None, description="The sources that have it; all if absent.")
    groundtruth: bool | None = Field(default=None, description="Instead of that of the collection.")
    uncertainty_m: Uncertainty | None = Field(default=None, description="Instead of that of the collection.")


class CollectionModel(_Model):
    """One file of ``datasets/catalogue``."""

    model_config = ConfigDict(title="SLAM Hive collection")
    format: Literal[1]
    name: Name
    title: str
    homepage: Address
    licence: str = Field(description="As its publisher states it; empty if nothing is stated.")
    citation: str
    importer: Name
    options: dict[str, str] = Field(default_factory=dict, description="Of the importer.")
    needs: list[NeedModel] = Field(default_factory=list)
    unverified: bool = Field(default=False, description="The addresses could not be tried.")
    note: str = ""
    attributes: Words = Field(default_factory=list, description="Of every sequence.")
    sensors: dict[SensorKind, int] = Field(description="Number of sensors of each kind.")
    groundtruth: bool = Field(default=True, description="Whether the files contain ground truth.")
    uncertainty_m: Uncertainty | None = Field(
        default=None, description="Of true positions along each axis, as published."
    )
    path: InnerPath = Field(default="", description="What the importer reads below the folder of a sequence.")
    files: dict[str, FileModel] = Field(default_factory=dict)
    sources: dict[Name, list[PartModel]] = Field(default_factory=dict, description="The first is the default.")
    sequences: dict[Name, SequenceModel | None] = Field(min_length=1)


def load_collection(path: Path) -> Collection:
    """Read one file of the catalogue; raises InvalidInput naming the file and the place."""
    try:
        model = CollectionModel.model_validate(strict_yaml.load(path))
    except ValidationError as error:
        raise InvalidInput(f"{path}: {first_problem(error, CollectionModel)}") from None
    check_name_in(path, "collection", model.name)
    if model.name != path.stem:
        raise InvalidInput(f"{path}: name {model.name!r} differs from the file's", "rename the one or the other")
    try:
        return Collection(
            name=model.name,
            title=model.title,
            homepage=model.homepage,
            licence=model.licence,
            citation=" ".join(model.citation.split()),
            importer=model.importer,
            options=model.options,
            needs=tuple(
                Need(need.kind, need.text, need.address or "", need.variable or "", need.host or "")
                for need in model.needs
            ),
            unverified=model.unverified,
            note=" ".join(model.note.split()),
            sequences=tuple(_sequence(model, name, own or SequenceModel()) for name, own in model.sequences.items()),
        )
    except InvalidInput as error:
        raise InvalidInput(f"{path}: {error.message}", error.remedy) from None


def _sequence(model: CollectionModel, name: str, own: SequenceModel) -> Sequence:
    values = {"sequence": name, **own.values}
    for chosen in own.sources or ():
        if chosen not in model.sources:
            raise InvalidInput(f"sequence {name}: there is no source {chosen!r}", f"use {', '.join(model.sources)}")
    sources = {
        source: tuple(_part(model, part, own, values) for part in parts)
        for source, parts in model.sources.items()
        if own.sources is None or source in own.sources
    }
    return Sequence(
        collection=model.name,
        name=name,
        attributes=tuple(dict.fromkeys((model.name, *model.attributes, *own.attributes))),
        sensors=model.sensors if own.sensors is None else own.sensors,
        sources=sources,
        path=_filled(model.path, values),
        groundtruth=model.groundtruth if own.groundtruth is None else own.groundtruth,
        uncertainty_m=model.uncertainty_m if own.uncertainty_m is None else own.uncertainty_m,
    )


def _part(model: CollectionModel, part: PartModel, own: SequenceModel, values: dict[str, str]) -> Part:
    key = _filled(part.file, values)
    if key not in model.files:
        raise InvalidInput(f"there is no file {key!r}", f"use {', '.join(model.files) or 'files'}")
    file = _file(key, model.files[key], own, values)
    return Part(file, _filled(part.take, values), _filled(part.to, values), part.unpack, part.optional)


def _file(key: str, model: FileModel, own: SequenceModel, values: dict[str, str]) -> RemoteFile:
    addresses = tuple(_filled(address, values) for address in (model.address, *model.mirrors))
    name = _filled(model.name, values) if model.name else unquote(PurePosixPath(urlsplit(addresses[0]).path).name)
    if not re.fullmatch(r"[A-Za-z0-9][\w.+-]{0,150}", name):
        raise InvalidInput(f"file {key}: {name!r} cannot be a file name", "give it a name")
    return RemoteFile(
        name=name,
        addresses=addresses,
        kind=model.kind or kind_of(name),
        size_bytes=own.bytes.get(key, model.bytes),
        about_bytes=model.about_bytes,
        checksum=own.checksums.get(key, model.checksum),
    )


def _filled(text: str, values: dict[str, str]) -> str:
    """``text`` with its placeholders replaced; raises InvalidInput for one without a value."""

    def value(found: re.Match[str]) -> str:
        if found[1] not in values:
            raise InvalidInput(f"{found[0]} in {text!r} has no value", f"known: {', '.join(values)}")
        return values[found[1]]

    return _PLACEHOLDER.sub(value, text)
