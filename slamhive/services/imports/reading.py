"""Read trajectories in common formats: conventions, path patterns, and the run that each file becomes."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from slamhive.base.errors import InvalidInput
from slamhive.domain.protocol import Duplicates
from slamhive.services.imports.request import ImportCandidate, Reading
from slamhive.trajectory.association import orientation_spread_deg, reordered, thinned_pair
from slamhive.trajectory.evidence import Conclusion, Span, span_of
from slamhive.trajectory.layout import Convention, QuaternionOrder, TimeUnit, format_tum
from slamhive.trajectory.model import ZERO, Trajectory
from slamhive.trajectory.pose_file import PoseFile, TrajectoryFormat, decided, read_pose_file

# Conventions: as specified, or detected; in doubt the import asks.

_Choice = TypeVar("_Choice", TimeUnit, QuaternionOrder)

_PARTNERS = 5
"""At most this many estimates are compared with a ground truth to detect its conventions."""


@dataclass(frozen=True, slots=True, eq=False)
class ImportTruth:
    """A ground truth for comparison with estimates; ``rotations_known``: its orientations are meaningful."""

    trajectory: Trajectory
    rotations_known: bool

    @property
    def span(self) -> Span:
        """First and last timestamp, in s."""
        return float(self.trajectory.stamps_s[0]), float(self.trajectory.stamps_s[-1])


@dataclass(frozen=True, slots=True)
class Partner:
    """An estimate that belongs to a ground truth, and the conventions that the user specified."""

    file: PoseFile
    told: Convention


def settle(
    file: PoseFile, name: str, told: Convention, truth: ImportTruth | None, relations: Span | None = None
) -> Reading:
    """Determine the conventions of an estimate; raises InvalidInput with the evidence if in doubt.

    ``relations`` is the time in s that relations span. It shows the unit where there is no ground truth.
    """
    unit = file.unit(told, relations, "the relations") if truth is None else file.unit(told, truth.span)
    time_unit = _decided(unit, "time unit", "--time-unit", TimeUnit)
    if not file.has_order:
        return _reading(file, name, time_unit, unit.because, None)
    order = file.order(told, time_unit, {} if truth is None else _spreads_deg(file, time_unit, truth))
    _decided(order, "quaternion order", "--quaternion-order", QuaternionOrder)
    return _reading(file, name, time_unit, unit.because, order)


def settle_truth(file: PoseFile, name: str, told: Convention, partners: Sequence[Partner]) -> Reading:
    """Determine the conventions of a ground truth, with the help of its estimates if necessary.

    Raises as :func:`settle`.
    """
    asked = partners[:_PARTNERS]
    unit = file.unit(told, None)
    for partner in asked:
        if unit.value is not None:
            break
        # An estimate helps if its own unit is clear without a ground truth.
        own = partner.file.unit(partner.told, None).value
        span = None if own is None else span_of(partner.file.raw.times, own)
        found = unit if span is None else file.unit(told, span)
        unit = unit if found.value is None else found
    time_unit = _decided(unit, "time unit", "--groundtruth-time-unit", TimeUnit)
    if not file.has_order:
        return _reading(file, name, time_unit, unit.because, None)
    order = _truth_order(file, told, time_unit, asked)
    _decided(order, "quaternion order", "--groundtruth-quaternion-order", QuaternionOrder)
    return _reading(file, name, time_unit, unit.because, order)


def _truth_order(
    file: PoseFile, told: Convention, unit: TimeUnit, partners: Sequence[Partner]
) -> Conclusion[QuaternionOrder]:
    """The quaternion order of a ground truth; estimates may contradict its header or replace a missing one."""
    by_itself = file.order(told, unit, {})
    if told.quaternion_order is not None:
        return by_itself
    stated = file.stated_order(unit) is not None
    for partner in partners:
        # The spread of each order of the ground truth, with the better of the two orders of the estimate. An order that
        # the ground truth states is contradicted only by an estimate whose order is certain.
        best_deg: dict[QuaternionOrder, float] = {}
        for order in QuaternionOrder:
            truth = ImportTruth(file.raw.trajectory(unit, order, Duplicates.KEEP), rotations_known=True)
            own_unit = partner.file.unit(partner.told, truth.span).value
            if own_unit is None or not partner.file.has_order:
                best_deg = {}
                break
            spreads_deg = _spreads_deg(partner.file, own_unit, truth)
            known = partner.told.quaternion_order if stated else partner.file.order(partner.told, own_unit, {}).value
            likely_deg = [spread_deg for own, spread_deg in spreads_deg.items() if known in (None, own)]
            if likely_deg:
                best_deg[order] = min(likely_deg)
        if best_deg:
            found = file.order(told, unit, best_deg)
            if by_itself.value is not None or found.value is not None:
                return found
    return by_itself


def _spreads_deg(file: PoseFile, unit: TimeUnit, truth: ImportTruth) -> dict[QuaternionOrder, float]:
    """The rotation difference between estimate and ground truth for each quaternion order."""
    if not truth.rotations_known:
        return {}
    pair = thinned_pair(truth.trajectory, file.raw.trajectory(unit, QuaternionOrder.XYZW, Duplicates.KEEP))
    if pair is None:
        return {}
    reference, estimate = pair
    found = {order: orientation_spread_deg(reference, reordered(estimate, order)) for order in QuaternionOrder}
    return {order: spread for order, spread in found.items() if spread is not None}


def _decided(finding: Conclusion[_Choice], what: str, option: str, choices: type[_Choice]) -> _Choice:
    return decided(finding, f"the {what}", f"say which it is with {option} ({', '.join(choices)})")


def _reading(
    file: PoseFile, name: str, unit: TimeUnit, because: str, order: Conclusion[QuaternionOrder] | None
) -> Reading:
    reasons = {"time_unit": because} | ({} if order is None else {"quaternion_order": order.because})
    if file.raw.without:
        reasons["orientation"] = f"{file.raw.without}, so there are positions only, and no rotation errors"
    plain = unit is TimeUnit.S and (order is None or order.value is QuaternionOrder.XYZW)
    return Reading(
        name=name,
        time_unit=unit,
        quaternion_order=None if order is None else order.value,
        because=reasons,
        as_it_stands=plain and file.format is TrajectoryFormat.TUM and file.plain and file.raw.without != ZERO,
    )


_HALF = 16
_FEWEST_POSES = 2


@dataclass(frozen=True, slots=True)
class Loaded:
    """A candidate whose conventions are known.

    Attributes:
        candidate: The file.
        text: In TUM format; the original bytes if the file was in that format.
        kitti_poses: The bytes of the file itself if it was in KITTI format, else None.
        poses: Number of poses.
        format: The layout of its rows.
        checksum: Of the file, ``sha256:<hex>``.
        reading: Its conventions.
    """

    candidate: ImportCandidate
    text: bytes
    kitti_poses: bytes | None
    poses: int
    format: TrajectoryFormat
    checksum: str
    reading: Reading

    @property
    def uid(self) -> str:
        """32 hex digits: the first half identifies the trial, the second its estimate."""
        return trial_digits(self.candidate) + hashlib.sha256(self.text).hexdigest()[:_HALF]


@dataclass(frozen=True, slots=True)
class LoadedTruth:
    """A ground truth whose numbers are understood.

    Attributes:
        text: In TUM format, or lines of timestamp and position; the bytes of the file itself if they were.
        kitti_poses: The bytes of the file itself if it was in KITTI format, else None.
        truth: What estimates are compared with.
        reading: Its conventions.
    """

    text: bytes
    kitti_poses: bytes | None
    truth: ImportTruth
    reading: Reading


def trial_digits(candidate: ImportCandidate) -> str:
    """The common prefix of the ids of all imports of one trial."""
    names = f"{candidate.algorithm}\0{candidate.dataset}\0{candidate.trial}"
    return hashlib.sha256(names.encode()).hexdigest()[:_HALF]


def read_candidate(candidate: ImportCandidate) -> PoseFile:
    """Read the numbers of a candidate; raises NotFound or InvalidInput naming file, line and value."""
    found = read_pose_file(candidate.path, candidate.format, candidate.times, columns=candidate.columns)
    _check_length(found, "trajectory")
    return found


def load(
    candidate: ImportCandidate,
    file: PoseFile,
    truth: ImportTruth | None,
    duplicates: Duplicates,
    relations: Span | None = None,
) -> Loaded:
    """Determine the conventions of a candidate; raises InvalidInput if they are unclear or it is no trajectory.

    ``truth`` is the ground truth for comparison, None if there is none. ``relations`` is the time in s of relations.
    """
    reading = settle(file, candidate.name, candidate.told, truth, relations)
    trajectory = _trajectory(file, reading, duplicates)
    kitti_poses = file.data if file.format is TrajectoryFormat.KITTI else None
    return Loaded(
        candidate=candidate,
        text=_text(file, reading, trajectory),
        kitti_poses=kitti_poses,
        poses=len(trajectory),
        format=file.format,
        checksum=f"sha256:{hashlib.sha256(file.data).hexdigest()}",
        reading=reading,
    )


def load_truth(
    path: Path, times: Path | None, name: str, told: Convention, partners: Sequence[Partner], duplicates: Duplicates
) -> LoadedTruth:
    """A ground truth, which may hold positions alone; raises NotFound or InvalidInput.

    ``partners`` may tell its unit and order where it does not by itself. ``name`` is what its reading is called.
    """
    file = read_pose_file(path, TrajectoryFormat.AUTO, times, positions=True)
    _check_length(file, "ground truth")
    reading = settle_truth(file, name, told, partners)
    trajectory = _trajectory(file, reading, duplicates)
    kitti_poses = file.data if file.format is TrajectoryFormat.KITTI else None
    text = _text(file, reading, trajectory, positions=True)
    return LoadedTruth(text, kitti_poses, ImportTruth(trajectory, file.raw.orientations), reading)


def read_truth_here(path: Path, *, positions_only: bool) -> ImportTruth | None:
    """The ground truth of a dataset that is here; None if it cannot be read, which an evaluation will tell."""
    try:
        file = read_pose_file(path, TrajectoryFormat.TUM, None, positions=True)
        trajectory = file.raw.trajectory(TimeUnit.S, QuaternionOrder.XYZW, Duplicates.KEEP)
    except InvalidInput:
        return None
    return ImportTruth(trajectory, file.raw.orientations and not positions_only)


def _check_length(file: PoseFile, kind: str) -> None:
    if len(file.raw.times) < _FEWEST_POSES:
        raise InvalidInput(f"{file.raw.table.name} holds a single pose", f"a {kind} needs two at least")


def _trajectory(file: PoseFile, reading: Reading, duplicates: Duplicates) -> Trajectory:
    """All poses of the file, including duplicates: the evaluation decides which of those count."""
    kept = Duplicates.REFUSE if duplicates is Duplicates.REFUSE else Duplicates.KEEP
    return file.raw.trajectory(reading.time_unit, reading.quaternion_order or QuaternionOrder.XYZW, kept)


def _text(file: PoseFile, reading: Reading, trajectory: Trajectory, *, positions: bool = False) -> bytes:
    """The text that runs and datasets store; with ``positions``, a file without orientations has those alone."""
    if reading.as_it_stands:
        return file.data
    if positions and not file.raw.orientations:
        rows = zip(trajectory.stamps_s.tolist(), trajectory.positions_m.tolist(), strict=True)
        return "".join(f"{stamp_s:.9f} {x:.9f} {y:.9f} {z:.9f}\n" for stamp_s, (x, y, z) in rows).encode()
    return format_tum(trajectory.stamps_s, trajectory.positions_m, trajectory.quats_xyzw).encode()


# Path patterns such as ``<algorithm>/<dataset>/<trial>.txt``, which read fields from a file's path.

FIELDS = ("algorithm", "dataset", "trial")
_FIELD = re.compile(r"<([^<>]*)>")


class PathPattern:
    """A pattern for paths below a folder: ``<field>`` reads a part, ``*`` matches anything within one part.

    Args:
        text: The pattern, with ``/`` between parts.
        fields: The allowed names.
        needed: The required names.

    Raises InvalidInput for an unknown field, one that is used twice or one that is missing.
    """

    def __init__(self, text: str, fields: Collection[str] = FIELDS, needed: Collection[str] = ()) -> None:
        self.text = text
        self.fields: list[str] = _FIELD.findall(text)
        for name in self.fields:
            if name not in fields:
                raise InvalidInput(
                    f"pattern {text!r} has an unknown field <{name}>",
                    f"fields are {', '.join(f'<{field}>' for field in fields)}",
                )
            if self.fields.count(name) > 1:
                raise InvalidInput(f"pattern {text!r} has the field <{name}> twice")
        missing = [name for name in needed if name not in self.fields]
        if missing:
            raise InvalidInput(
                f"pattern {text!r} lacks <{missing[0]}>", "for example <algorithm>/<dataset>/<trial>.txt"
            )
        if text.startswith("/") or ".." in text.split("/"):
            raise InvalidInput(f"pattern {text!r} leaves the folder", "give a path below it")
        self._expression = re.compile(_expression(text))

    def match(self, path: str) -> dict[str, str] | None:
        """The fields of ``path`` (relative, with ``/``); None if it does not match."""
        found = self._expression.fullmatch(path)
        return None if found is None else found.groupdict()


def _expression(text: str) -> str:
    parts = _FIELD.split(text)
    literal, names = parts[0::2], parts[1::2]
    expression = _literal(literal[0])
    for name, after in zip(names, literal[1:], strict=True):
        expression += f"(?P<{name}>[^/]+?){_literal(after)}"
    return expression


def _literal(text: str) -> str:
    return "[^/]*".join(re.escape(part) for part in text.split("*"))
