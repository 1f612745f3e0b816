"""Public sequences and the addresses of their files as JSON."""

from __future__ import annotations

from typing import Annotated

from slamhive.domain.collection import Collection, NeedKind, Sequence
from slamhive.domain.sensors import SensorSetup
from slamhive.schema.fields import described
from slamhive.schema.model import Document


class Need(Document):
    """What must be accepted or asked for before a download."""

    kind: NeedKind
    text: Annotated[str, described("What to do.")]
    address: Annotated[str, described("Where; empty if it does not matter.")]
    variable: Annotated[str, described("The environment variable that holds the token; empty for other kinds.")]


class PublicSequence(Document):
    """A recording of a public collection, which `slamhive dataset fetch` makes a dataset of."""

    name: Annotated[str, described("What to fetch: COLLECTION/SEQUENCE.")]
    title: str
    homepage: str
    importer: Annotated[str, described("The format of its files.")]
    licence: Annotated[str, described("As its publisher states it; empty if nothing is stated.")]
    citation: str
    attributes: tuple[str, ...]
    setups: Annotated[tuple[SensorSetup, ...], described("The sensor set-ups that it can serve.")]
    groundtruth: Annotated[bool, described("The files contain ground truth.")]
    download_bytes: Annotated[int | None, described("Of the default source; null if unknown.", unit="bytes")]
    exact: Annotated[bool, described("The size is exact, not rounded.")]
    shared: Annotated[bool, described("Its files hold other sequences too.")]
    sources: tuple[str, ...]
    needs: tuple[Need, ...]
    unverified: Annotated[bool, described("Nobody has tried the addresses since they were written down.")]


class LinkReport(Document):
    """What an address of the catalogue answered."""

    address: str
    problem: Annotated[str | None, described("Why it gives no file; null if it does.")]
    size_bytes: Annotated[int | None, described("What it offers.", unit="bytes")]
    ranges: Annotated[bool | None, described("Downloads can be continued.")]
    duration_s: Annotated[float, described("Until it answered.", unit="s")]


def public_sequence(collection: Collection, sequence: Sequence) -> PublicSequence:
    """A sequence of a collection as JSON shows it."""
    files = {part.file.name: part.file for part in sequence.parts}.values()
    sizes = [file.estimate_bytes for file in files]
    known = bool(sizes) and None not in sizes
    return PublicSequence(
        name=sequence.full_name,
        title=collection.title,
        homepage=collection.homepage,
        importer=collection.importer,
        licence=collection.licence,
        citation=collection.citation,
        attributes=sequence.attributes,
        setups=sequence.setups,
        groundtruth=sequence.groundtruth,
        download_bytes=sum(size for size in sizes if size is not None) if known else None,
        exact=known and all(file.size_bytes is not None for file in files),
        shared=any(collection.sharing(file) > 1 for file in files),
        sources=tuple(sequence.sources),
        needs=tuple(Need.of(need) for need in collection.needs),
        unverified=collection.unverified,
    )
