"""The map of one run as an input of another."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from slamhive.bags.staging import checksum
from slamhive.domain.algorithm import Algorithm
from slamhive.domain.configuration import InputMap
from slamhive.errors import InvalidInput
from slamhive.runs.folder import RunFolder
from slamhive.store import Store, Transaction
from slamhive.store.records import RunRecord

_UID = re.compile(r"[0-9a-f]{32}")
_MOST_DIGITS = 18


@dataclass(frozen=True, slots=True)
class FoundMap:
    """A map that a run has saved: what configurations say of it, its file, and the dataset that it shows."""

    map: InputMap
    path: Path
    dataset: str

    def note(self, dataset: str) -> str | None:
        """In words, that the map shows another dataset than the run uses; None if it is the same."""
        if dataset == self.dataset:
            return None
        return f"the map shows {self.dataset}, the run uses {dataset}: this only helps if both are of the same place"


def find_map(store: Store, runs_folder: Path, reference: str, algorithm: Algorithm) -> FoundMap:
    """The map of the run with this number or uid, for a run of ``algorithm``.

    Raises NotFound if there is no such run, InvalidInput if it has no map that the algorithm can start with.
    """
    file = algorithm.package.map_output
    if not algorithm.map_input or file is None:
        raise InvalidInput(
            f"{algorithm.name} cannot start with a map", "leave the map out, or choose another algorithm"
        )
    run = store.read(lambda t: t.runs.get(_number(t, reference)))
    path = _checked(run, runs_folder, algorithm, file)
    try:
        content = checksum(path)
    except OSError as error:
        raise InvalidInput(f"the map {path} cannot be read: {error.strerror}", "put it back") from None
    return FoundMap(InputMap(run.uid, content), path, run.dataset)


def _number(t: Transaction, reference: str) -> int:
    if _UID.fullmatch(reference):
        known = t.runs.ids_by_uid([reference])
        if reference in known:
            return known[reference]
    elif reference.isascii() and reference.isdigit() and len(reference) <= _MOST_DIGITS:
        return int(reference)
    raise InvalidInput(f"no run has the number or uid {reference[:40]!r}", "slamhive runs lists all")


def _checked(run: RunRecord, runs_folder: Path, algorithm: Algorithm, file: str) -> Path:
    if run.algorithm != algorithm.name:
        raise InvalidInput(
            f"run {run.id} has a map of {run.algorithm}, which {algorithm.name} cannot read",
            f"name a run of {algorithm.name}",
        )
    if not run.state.ended:
        raise InvalidInput(f"run {run.id} is {run.state}: its map is not complete", "wait until it has ended")
    path = RunFolder(runs_folder / str(run.id)).result / file
    if not path.is_file() or path.is_symlink():
        raise InvalidInput(f"run {run.id} has saved no map", f"repeat it with --set save_map=true: it lacks {file}")
    return path
