"""Checks a submission by what is public: format, names, time range. The ground truth is not asked."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from slamhive.budget import Lent, Share
from slamhive.domain.challenge import Format
from slamhive.domain.numbers import plural
from slamhive.errors import InvalidInput, nearest
from slamhive.schema.challenge import PhaseEntry, SequenceEntry, StoredFile
from slamhive.services.challenges.definition import Definition
from slamhive.trajectory.completeness import measure_completeness
from slamhive.trajectory.kitti import parse_kitti_matrices
from slamhive.trajectory.tum import parse_tum

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
    definition: Definition, phase: PhaseEntry, files: Mapping[str, Path], share: Share
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


def _checked(definition: Definition, entry: SequenceEntry, name: str, path: Path, share: Share) -> CheckedFile:
    kind = definition.preset.format
    with in_memory(path, name, kind, share) as data:
        if kind is Format.KITTI:
            facts = _check_frames(entry, name, data)
        else:
            facts = check_trajectory(definition, entry, name, data)
    return CheckedFile(entry.name, facts, path, kind)


@contextmanager
def in_memory(path: Path, name: str, kind: Format, share: Share) -> Iterator[bytes]:
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
    """What the time range of a sequence says of a TUM trajectory; raises InvalidInput if it is none of the sequence."""
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


def _check_frames(entry: SequenceEntry, name: str, data: bytes) -> StoredFile:
    matrices = parse_kitti_matrices(data, name)
    if len(matrices) != entry.poses:
        raise InvalidInput(f"{name} has {len(matrices)} poses, {entry.name} has {entry.poses} frames", "write them all")
    return StoredFile(poses=len(matrices), coverage=None, enough=True)
