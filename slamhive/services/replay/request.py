"""What is asked of a replay, and what it found in the bundle."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from slamhive.domain.gate import Margin
from slamhive.domain.run import RunState
from slamhive.errors import InvalidInput
from slamhive.schema.gate import BaselineConfiguration
from slamhive.services.archive import ArchiveReader, recorded_runs
from slamhive.store import RunRecord, VersionRecord


@dataclass(frozen=True, slots=True)
class ReplayRequest:
    """How a bundle is replayed.

    Attributes:
        path: The bundle, a file that ``slamhive archive export`` wrote.
        repeats: How often each configuration runs.
        executor: Where; None for the executor of the recorded runs.
        load_image: Whether packages and images may be taken from the bundle. They are code that runs here.
        rebuild: Whether a package may be built again, which makes another image or environment.
        margins: Texts such as ``ate.rmse=5%``, on top of the defaults.
    """

    path: Path
    repeats: int = 5
    executor: str | None = None
    load_image: bool = False
    rebuild: bool = False
    margins: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Needs:
    """The runs of a bundle that can run again, by uid, and {dataset: checksum}; how many others there are, by reason.

    The checksum is None if it was not recorded.
    """

    uids: tuple[str, ...]
    datasets: Mapping[str, str | None]
    left_out: Counter[str]


def needs_of(archive: ArchiveReader) -> Needs:
    """What the bundle needs; raises InvalidInput if none of its runs can run again."""
    uids, datasets, left_out = [], dict[str, str | None](), Counter[str]()
    for _, file in recorded_runs(archive):
        reason = None
        if file.imported is not None:
            reason = "made by another tool"
        elif file.state not in (RunState.SUCCEEDED, RunState.FAILED) or file.algorithm.identity is None:
            reason = "never ran to an end"
        if reason is not None:
            left_out[reason] += 1
            continue
        name, checksum = file.request.dataset, file.dataset.checksum
        if datasets.setdefault(name, checksum) != checksum:
            raise InvalidInput(f"the runs of the bundle used several contents of dataset {name}", "export some of them")
        uids.append(file.uid)
    if not uids:
        found = ", ".join(f"{count} {reason}" for reason, count in left_out.items())
        raise InvalidInput(
            f"no run of the bundle can run again: {found}", "slamhive archive verify shows what it holds"
        )
    return Needs(tuple(uids), datasets, left_out)


@dataclass(frozen=True, slots=True)
class Recorded:
    """One configuration of a bundle: its recorded runs with their values, and the version that will run again.

    ``executor`` is the name of the one that runs it.
    """

    held: BaselineConfiguration
    runs: tuple[RunRecord, ...]
    version: VersionRecord
    executor: str

    @property
    def recorded_identity(self) -> str:
        """The image or environment of the recorded runs."""
        version = self.runs[0].version
        assert version is not None
        return version.identity


@dataclass(frozen=True, slots=True)
class Prepared:
    """A replay that can begin."""

    request: ReplayRequest
    margins: Mapping[str, Margin]
    configurations: tuple[Recorded, ...]
    notes: tuple[str, ...]
