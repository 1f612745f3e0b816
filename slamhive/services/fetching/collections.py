"""The catalogue of public collections: what can be fetched, found by words."""

from __future__ import annotations

from collections.abc import Sequence as Sequences
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path

from slamhive.catalogue.collection_file import load_collection
from slamhive.domain.collection import Collection, Sequence
from slamhive.errors import InvalidInput, NotFound, nearest, unknown

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
