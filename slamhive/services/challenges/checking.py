"""Checks a submission by what is public: format, names, time range. The ground truth is not asked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np

from slamhive.domain.challenge import Format
from slamhive.domain.numbers import plural
from slamhive.errors import InvalidInput, nearest
from slamhive.schema.challenge import PhaseEntry, SequenceEntry, StoredFile
from slamhive.services.challenges.definition import Definition
from slamhive.services.challenges.frames import frame_trajectory
from slamhive.trajectory.completeness import measure_completeness
from slamhive.trajectory.kitti import parse_kitti_matrices
from slamhive.trajectory.tum import parse_tum

MOST_BYTES = 200_000_000
"""All files of a submission together."""
LEAST_POSES = 3
ENDINGS = (".txt", ".tum", ".kitti", ".csv")


@dataclass(frozen=True, slots=True)
class CheckedFile:
    """A trajectory that can be evaluated: what is public of it, and the files to keep by name."""

    sequence: str
    facts: StoredFile
    files: Mapping[str, bytes]


def check_files(definition: Definition, phase: PhaseEntry, files: Mapping[str, bytes]) -> list[CheckedFile]:
    """Check the files of a submission by name, such as ``room-1.txt`` for the sequence room-1.

    Raises InvalidInput for a file that does not belong to the phase, or that is no trajectory of its sequence.
    """
    wanted = {entry.name: entry for entry in definition.sequences_of(phase)}
    total = sum(map(len, files.values()))
    if total > MOST_BYTES:
        raise InvalidInput(f"the files have {total:,} bytes, more than {MOST_BYTES:,}", "write fewer digits")
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
        _checked(definition, entry, by_sequence[sequence], files[by_sequence[sequence]])
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


def _checked(definition: Definition, entry: SequenceEntry, name: str, data: bytes) -> CheckedFile:
    if definition.preset.format is Format.KITTI:
        return _checked_frames(entry, name, data)
    return CheckedFile(entry.name, check_trajectory(definition, entry, name, data), {f"{entry.name}.tum": data})


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


def _checked_frames(entry: SequenceEntry, name: str, data: bytes) -> CheckedFile:
    matrices = parse_kitti_matrices(data, name)
    if len(matrices) != entry.poses:
        raise InvalidInput(f"{name} has {len(matrices)} poses, {entry.name} has {entry.poses} frames", "write them all")
    facts = StoredFile(poses=len(matrices), coverage=None, enough=True)
    files = {f"{entry.name}.kitti": data, f"{entry.name}.tum": frame_trajectory(matrices)}
    return CheckedFile(entry.name, facts, files)
