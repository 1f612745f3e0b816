"""Checks a submission by what is public: format, names, time range. The ground truth is not asked."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path, PurePosixPath

import numpy as np

from slamhive.base.budget import BudgetShare, Lent, unbounded
from slamhive.base.errors import InvalidInput, NotFound, nearest
from slamhive.base.files import temporary_folder
from slamhive.documents.challenge import PhaseEntry, SequenceEntry, StoredFile
from slamhive.domain.challenge import Format, RunFailure
from slamhive.domain.collection import FileKind
from slamhive.domain.names import plural
from slamhive.downloads.unpack import UnpackLimits, unpack
from slamhive.packages.collection_file import kind_of
from slamhive.run_folder.folder import RunFolder
from slamhive.services.challenges.definition import ChallengeFolder, Definition, SubmissionFolder
from slamhive.trajectory.completeness import measure_completeness
from slamhive.trajectory.kitti import parse_kitti_matrices
from slamhive.trajectory.layout import format_tum, parse_tum
from slamhive.trajectory.model import FloatArray
from slamhive.trajectory.table import read_bounded
from slamhive.trajectory.transforms import quats_from_rotations

MOST_BYTES = 200_000_000
"""All files of a submission together."""
MEMORY_PER_LINE = {Format.TUM: 300, Format.KITTI: 1200}
"""Most memory (bytes) that a line takes besides its text while a trajectory is read and checked; a test measures it."""
MOST_WAIT_S = 5.0
"""Longest that a check waits for the memory of others: a thread that waits serves no pages."""
LEAST_POSES = 3
_BLOCK_BYTES = 1 << 20
_LINE_ENDS = (b"\n", b"\r", b"\v", b"\f", b"\x1c", b"\x1d", b"\x1e", b"\xc2\x85", b"\xe2\x80\xa8", b"\xe2\x80\xa9")
ENDINGS = (".txt", ".tum", ".kitti", ".csv")


@dataclass(frozen=True, slots=True)
class CheckedFile:
    """A trajectory that can be evaluated: what is public of it, its file, and the format of that."""

    sequence: str
    facts: StoredFile
    path: Path
    format: Format


def check_files(
    definition: Definition, phase: PhaseEntry, files: Mapping[str, Path], share: BudgetShare
) -> list[CheckedFile]:
    """Check the files of a submission by name, such as ``room-1.txt`` for the sequence room-1, one after the other.

    The memory for each is taken out of ``share``. Raises InvalidInput for a file that does not belong to the phase, or
    that is no trajectory of its sequence; and as Share.take.
    """
    wanted = {entry.name: entry for entry in definition.sequences_of(phase)}
    by_sequence: dict[str, str] = {}
    for name in files:
        sequence = sequence_of(name)
        if sequence not in wanted:
            raise InvalidInput(
                f"{name[:100]} belongs to no sequence of phase {phase.name}; {nearest(sequence[:80], list(wanted))}",
                "name each file after its sequence, such as room-1.txt",
            )
        if sequence in by_sequence:
            raise InvalidInput(f"{by_sequence[sequence]} and {name} are of one sequence", "send one of them")
        by_sequence[sequence] = name
    _check_complete(definition, list(wanted), by_sequence)
    return [
        _checked(definition, entry, by_sequence[sequence], files[by_sequence[sequence]], share)
        for sequence, entry in wanted.items()
        if sequence in by_sequence
    ]


def sequence_of(name: str) -> str:
    """The sequence that a file is named after."""
    path = PurePosixPath(name)
    return path.stem if path.suffix.lower() in ENDINGS else path.name


def _check_complete(definition: Definition, wanted: Sequence[str], found: Mapping[str, str]) -> None:
    missing = [name for name in wanted if name not in found]
    if not found:
        raise InvalidInput("there is no trajectory", f"send one for each of {', '.join(wanted[:20])}")
    if missing and definition.scoring.worst is None:
        raise InvalidInput(
            f"{plural(len(missing), 'sequence')} without a trajectory: {', '.join(missing[:20])}",
            "every sequence is needed",
        )


def _checked(definition: Definition, entry: SequenceEntry, name: str, path: Path, share: BudgetShare) -> CheckedFile:
    kind = definition.preset.format
    with in_memory(path, name, kind, share) as data:
        if kind is Format.KITTI:
            matrices = parse_kitti_matrices(data, name)
            if len(matrices) != entry.poses:
                raise InvalidInput(
                    f"{name} has {len(matrices)} poses, {entry.name} has {entry.poses} frames", "write them all"
                )
            facts = StoredFile(poses=len(matrices), coverage=None, enough=True)
        else:
            facts = check_trajectory(definition, entry, name, data)
    return CheckedFile(entry.name, facts, path, kind)


@contextmanager
def in_memory(path: Path, name: str, kind: Format, share: BudgetShare) -> Iterator[bytes]:
    """The content of a file for the block, with enough memory to read it as a trajectory of this format.

    Raises InvalidInput if it is not there or too large, and as Share.take.
    """
    size, lines = 0, 0
    try:
        with path.open("rb") as stream:
            while block := stream.read(_BLOCK_BYTES):
                size, lines = size + len(block), lines + sum(block.count(end) for end in _LINE_ENDS)
                if size > MOST_BYTES:
                    raise InvalidInput(f"{name} has more than {MOST_BYTES:,} bytes", "send trajectories only")
    except OSError as error:
        raise InvalidInput(f"{name} cannot be read: {error.strerror}") from None
    with share.lend(Lent.MEMORY, size + MEMORY_PER_LINE[kind] * lines + _BLOCK_BYTES, MOST_WAIT_S):
        yield path.read_bytes()


def check_trajectory(definition: Definition, entry: SequenceEntry, name: str, data: bytes) -> StoredFile:
    """Compare a TUM trajectory with the time range of its sequence; raises InvalidInput if it does not belong to it."""
    assert entry.time_range_s is not None  # the definition was checked
    first_s, last_s = entry.time_range_s
    stamps_s = parse_tum(data, name, definition.protocol.duplicates).stamps_s + definition.protocol.time_offset_s
    inside = int(np.count_nonzero((stamps_s >= first_s) & (stamps_s <= last_s)))
    if inside < LEAST_POSES:
        raise InvalidInput(
            f"{name}: {inside} of {len(stamps_s)} poses lie in the time range of {entry.name}, {first_s:g} to "
            f"{last_s:g} s",
            "write the timestamps of the recording, in seconds",
        )
    gap_s = definition.protocol.gap_threshold_s
    coverage = measure_completeness(stamps_s, np.array(entry.time_range_s), gap_s).tracked_fraction
    return StoredFile(poses=len(stamps_s), coverage=coverage, enough=coverage >= definition.file.least_coverage)


# Files of a submission: trajectories, folders of them, and archives. They stay on the disk.

MOST_FILES = 1000
_LIMITS = UnpackLimits(ratio=50.0, always_bytes=20_000_000, total_bytes=MOST_BYTES, files=MOST_FILES)
"""Text of digits shrinks to a third, and to a twentieth where nothing moves."""


@contextmanager
def opened_files(paths: Iterable[Path], share: BudgetShare | None = None) -> Iterator[dict[str, Path]]:
    """The files of a submission by name, for the block. A folder, or a zip or tar archive, stands for the files in it.

    Args:
        paths: What was sent.
        share: What is unpacked is taken out of it; None for no limit but those of a submission.

    Raises InvalidInput for what cannot be read or is too large, and for two files of one name; and as Share.take.
    """
    share = share or unbounded("a submission")
    found: dict[str, Path] = {}
    total = 0
    with ExitStack() as unpacked:
        for path in paths:
            for file in _files(path, share, unpacked):
                if file.name in found:
                    raise InvalidInput(f"two files are called {file.name}", "send one of them")
                found[file.name] = file
                total += _size_bytes(file)
                if total > MOST_BYTES or len(found) > MOST_FILES:
                    raise InvalidInput(f"{path.name} holds too much", "send trajectories only")
        yield found


def _files(path: Path, share: BudgetShare, unpacked: ExitStack) -> Iterator[Path]:
    kind = kind_of(path.name)
    if path.is_dir():
        yield from (file for file in sorted(path.rglob("*")) if file.is_file() and not file.name.startswith("."))
    elif kind in (FileKind.ZIP, FileKind.TAR):
        folder = unpacked.enter_context(temporary_folder())
        unpack(path, kind, folder, limits=_LIMITS, room=partial(share.take, Lent.DISK))
        yield from _files(folder, share, unpacked)
    else:
        yield path


def _size_bytes(path: Path) -> int:
    try:
        size = path.stat().st_size
    except OSError as error:
        raise InvalidInput(f"{path} cannot be read: {error.strerror}") from None
    if size > MOST_BYTES:
        raise InvalidInput(f"{path.name} has more than {MOST_BYTES:,} bytes", "send trajectories only")
    return size


# Trajectories to evaluate, and why others cannot be.


@dataclass(frozen=True, slots=True)
class Estimate:
    """A trajectory to evaluate; ``frames`` is the same in the KITTI format."""

    id: str
    sequence: str
    path: Path
    frames: Path | None = None


@dataclass
class Estimates:
    """Trajectories of a submission, and by sequence the reasons why others do not count."""

    found: list[Estimate] = field(default_factory=list)
    failures: dict[str, list[RunFailure]] = field(default_factory=dict)

    def fail(self, sequence: str, failure: RunFailure) -> None:
        """One trajectory of ``sequence`` does not count."""
        self.failures.setdefault(sequence, []).append(failure)


def estimates_of(folder: ChallengeFolder, found: SubmissionFolder) -> Estimates:
    """The trajectories of a submission; of an image whose runs have ended, those that they left."""
    made = Estimates()
    if found.sent.image is not None:
        ended = folder.ended_runs(found.root.name)
        assert ended is not None  # it is asked for only then
        runs = folder.installation(found.root.name) / "runs"
        for run in ended.runs:
            if run.failure is not None or run.run is None:
                made.fail(run.sequence, _known(run.failure))
                continue
            definition, path = folder.full_definition, RunFolder(runs / str(run.run)).trajectory
            try:
                checked = check_trajectory(
                    definition, definition.sequences[run.sequence], path.name, read_bounded(path)
                )
            except (InvalidInput, NotFound):
                made.fail(run.sequence, RunFailure.NO_TRAJECTORY)
                continue
            if checked.enough:
                made.found.append(Estimate(f"{found.sent.id}/{run.sequence}/{run.run}", run.sequence, path))
            else:
                made.fail(run.sequence, RunFailure.TOO_LITTLE)
        return made
    kitti = folder.definition.preset.format is Format.KITTI
    for name, facts in found.sent.files.items():
        if facts.enough:
            frames = found.root / f"{name}.kitti" if kitti else None
            made.found.append(Estimate(f"{found.sent.id}/{name}", name, found.root / f"{name}.tum", frames))
        else:
            made.fail(name, RunFailure.TOO_LITTLE)
    return made


def _known(failure: str | None) -> RunFailure:
    return next((entry for entry in RunFailure if entry == failure), RunFailure.ORGANISER)


# Trajectories without timestamps, one pose a frame, as the evaluation takes them.

FRAME_S = 0.1
"""Poses are matched by index, so any interval will do; the scanner of KITTI turns ten times a second."""


def frame_trajectory(matrices: FloatArray) -> bytes:
    """The text of a TUM file of poses, shape (n, 4, 4), that are equally spaced in time."""
    stamps_s = FRAME_S * np.arange(len(matrices), dtype=np.float64)
    return format_tum(stamps_s, matrices[:, :3, 3], quats_from_rotations(matrices[:, :3, :3])).encode()
