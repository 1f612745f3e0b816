"""Meanings of the numbers in files of the published SLAM Hive.

Its files name algorithms, datasets, experiments (combinations) and configurations by their numbers in the database of
their installation. In another installation the same number is something else. So a number is taken only if the file or
its user says what it means. Every list of runs imports this module, so it reads no files.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from slamhive.base.errors import InvalidInput

HERE = "here"
"""What ``ids`` says where the numbers of a file are those of this installation."""

_KINDS = ("algorithm", "dataset", "experiment", "configuration")
_MOST_DIGITS = 18


@dataclass(frozen=True, slots=True)
class Numbers:
    """Names by number. ``configurations`` are the numbers here by those in the file; None: the same."""

    algorithms: Mapping[int, str] = field(default_factory=dict)
    datasets: Mapping[int, str] = field(default_factory=dict)
    experiments: Mapping[int, str] = field(default_factory=dict)
    configurations: Mapping[int, int] | None = None

    @property
    def of_algorithms(self) -> dict[str, int]:
        """The number of each algorithm."""
        return {name: number for number, name in self.algorithms.items()}

    @property
    def of_datasets(self) -> dict[str, int]:
        """The number of each dataset."""
        return {name: number for number, name in self.datasets.items()}


def meant(ids: object, given: Mapping[str, str], here: Numbers, place: object) -> Numbers | None:
    """Meanings of the numbers in a file, as far as it or its user says; None if they are those of this installation.

    Args:
        ids: The key ``ids`` of the file: ``here``, or for each kind {number: meaning}; None if absent.
        given: What a user said: {"algorithm:3": name}, {"3": name}, or {"here": "here"} for a file without ``ids``.
        here: The numbers of this installation, whose names say which kind is meant.
        place: Where ``ids`` stands, for messages.

    Raises InvalidInput for what cannot be understood.
    """
    if ids == HERE or (ids is None and HERE in given):
        return None
    found: dict[str, dict[int, str]] = {kind: {} for kind in _KINDS}
    if ids is not None and not isinstance(ids, dict):
        raise InvalidInput(f"{place}: ids is 'here', or numbers for {', '.join(_KINDS)}; found {ids!r}")
    for kind, entries in (ids or {}).items():
        if kind not in found or not isinstance(entries, dict):
            raise InvalidInput(f"{place}: ids holds numbers for {', '.join(_KINDS)}; found {kind}: {entries!r}")
        for number, meaning in entries.items():
            found[kind][_number(number, f"{place}: ids")] = str(meaning)
    for text, meaning in (entry for entry in given.items() if entry[0] != HERE):
        kind, colon, number = text.rpartition(":")
        if colon and kind not in found:
            raise InvalidInput(f"--id {text}={meaning}: {kind!r} is none of {', '.join(_KINDS)}")
        found[kind if colon else _kind_of(text, meaning, here)][_number(number, "--id")] = meaning
    return Numbers(
        algorithms=found["algorithm"],
        datasets=found["dataset"],
        experiments=found["experiment"],
        configurations={old: _number(new, "a configuration") for old, new in found["configuration"].items()},
    )


def _kind_of(text: str, meaning: str, here: Numbers) -> str:
    """The kind of thing that is called ``meaning`` here; raises InvalidInput unless there is exactly one."""
    known = zip(_KINDS, (here.algorithms, here.datasets, here.experiments), strict=False)
    kinds = [kind for kind, names in known if meaning in names.values()]
    kinds += ["configuration"] if meaning.isdigit() else []
    if len(kinds) == 1:
        return kinds[0]
    found = " and ".join(kinds) or "nothing"
    raise InvalidInput(
        f"--id {text}={meaning}: {meaning} is {found} here", f"name the kind: --id algorithm:{text}={meaning}"
    )


def _number(text: object, owner: str) -> int:
    if not str(text).isascii() or not str(text).isdigit() or len(str(text)) > _MOST_DIGITS:
        raise InvalidInput(f"{owner}: {text!r} is not the number of anything", "write digits")
    return int(str(text))
