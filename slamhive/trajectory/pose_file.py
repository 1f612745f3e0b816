"""Files of poses in any of the common formats: layout and columns of rows, unit of times, order of quaternions."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TypeVar

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.domain.protocol import Duplicates
from slamhive.trajectory.evidence import Conclusion, Span, find_order, find_unit
from slamhive.trajectory.formats import find_format, format_named, read_pose_folder, refuse_keys, systems_by_columns
from slamhive.trajectory.kitti import read_kitti_rows
from slamhive.trajectory.layout import (
    QUATERNION_NAME,
    UNKNOWN,
    Convention,
    QuaternionOrder,
    RawPoses,
    TimeUnit,
    parse_position_rows,
    parse_rows,
    stated_in,
)
from slamhive.trajectory.model import QUATERNION_TOLERANCE, FloatArray, Trajectory, lacking, no_rotations
from slamhive.trajectory.table import count_columns, parse_table, read_bounded, text_lines
from slamhive.trajectory.transforms import quats_from_rotations

SYSTEMS = systems_by_columns()
"""Systems that write rows of so many columns, for messages."""
_MATRIX_COLUMNS, _WHOLE_MATRIX_COLUMNS, _POSE_COLUMNS = 13, 17, 8
_TIME = re.compile(r"^(?:t|sec|u?time.*|gpstime|stamp.*)$", re.IGNORECASE)
_POSITION = re.compile(
    r"^(?:t|p|pos|position|trans|translation|p_\w*|(?:\w+\.)*(?:position|translation))?[_.]?([xyz])$", re.IGNORECASE
)
_UNIT_WORDS = re.compile(r"[\[(][^\])]*[\])]")
_ORTHOGONAL = 1e-2


@dataclass(frozen=True, slots=True)
class Columns:
    """Where a row of ``count`` columns holds the pose, from 0.

    Attributes:
        count: How many columns a row has.
        time: That of the timestamp.
        position: Those of x, y and z.
        orientation: Four of a quaternion, nine of a matrix by rows, or none.
        order: Of the quaternion; None if nothing says it.
    """

    count: int
    time: int
    position: tuple[int, ...]
    orientation: tuple[int, ...]
    order: QuaternionOrder | None = None


def with_header_as_comment(data: bytes) -> bytes:
    """The bytes with ``#`` before a first line that names columns, as spreadsheets and OKVIS2 write it."""
    lines = data.removeprefix(b"\xef\xbb\xbf").split(b"\n")
    first = next((index for index, line in enumerate(lines) if line.strip()), None)
    if first is None or lines[first].lstrip().startswith(b"#"):
        return data
    names = _names(lines[first].decode("utf-8", errors="replace"))
    if _by_names(names) is None:
        return data
    lines[first] = b"#" + lines[first]
    return b"\n".join(lines)


def find_columns(data: bytes) -> Columns | None:
    """Where the rows hold the pose, if anything but a plain layout shows it; None for the plain ones and in doubt."""
    count = count_columns(data)
    for line in data.splitlines():
        text = line.decode("utf-8", errors="replace").strip()
        if text and not text.startswith("#"):
            break  # only the comments above the first row name columns
        names = _names(text)
        found = _by_names(names) if len(names) == count else None
        if found is not None:
            return found
    # The layout of a system that writes so many columns without names, if the numbers fit.
    if count not in SYSTEMS or count <= _POSE_COLUMNS:
        return None
    try:
        values = parse_table(data, "", count, "").values
    except InvalidInput:
        return None
    whole = count == _WHOLE_MATRIX_COLUMNS and (values[:, 13:] == [0, 0, 0, 1]).all()
    if count == _MATRIX_COLUMNS or whole:
        places = (1, 2, 3, 5, 6, 7, 9, 10, 11)
        R = values[:, list(places)].reshape(-1, 3, 3)
        with np.errstate(over="ignore", invalid="ignore"):
            fits = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max() < _ORTHOGONAL and (np.linalg.det(R) > 0).all()
        return Columns(count, 0, (4, 8, 12), places, QuaternionOrder.XYZW) if fits else None
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(np.linalg.norm(values[:, 4:8], axis=1) - 1)
    return Columns(count, 0, (1, 2, 3), (4, 5, 6, 7)) if (off <= QUATERNION_TOLERANCE).all() else None


def stated_columns(text: str, count: int) -> Columns:
    """The columns that a user names, such as ``t,x,y,z,qw,qx,qy,qz``; ``-`` is one that is left out.

    Raises InvalidInput.
    """
    names = [word.strip() for word in text.split(",")]
    remedy = "write for instance t,x,y,z,qw,qx,qy,qz, with - for columns that are left out"
    found = _by_names(names)
    if found is None or len(names) > count:
        problem = f"names {len(names)} of {count} columns" if found is not None else "lacks t, x, y, z, or a part of q"
        raise InvalidInput(f"--columns {text[:80]!r} {problem}", remedy)
    return Columns(count, found.time, found.position, found.orientation, found.order)


def parse_columns(data: bytes, name: str, columns: Columns) -> RawPoses:
    """The poses in those columns; raises InvalidInput naming line and value."""
    system = f", as of {SYSTEMS[columns.count]}" if columns.count in SYSTEMS else ""
    table = parse_table(data, name, columns.count, f"{columns.count} columns{system}")
    values = table.values
    stated = Convention(stated_in(data).time_unit, columns.order)
    times, positions_m = values[:, columns.time], values[:, list(columns.position)]
    if not columns.orientation:
        return RawPoses(table, times, positions_m, no_rotations(len(values)), orientations=False, stated=stated)
    quats = values[:, list(columns.orientation)]
    if len(columns.orientation) > 4:
        quats = quats_from_rotations(quats.reshape(-1, 3, 3))
    without = lacking(quats, positions_m)
    quats = no_rotations(len(values)) if without else quats
    return RawPoses(table, times, positions_m, quats, not without, stated, without)


def _names(line: str) -> list[str]:
    """The names of columns in a line, without units: ``# p_RS_R_x [m], ...``."""
    text = _UNIT_WORDS.sub("", line.lstrip("\ufeff# \t"))
    words = text.split(",") if "," in text else text.split()
    return [word.strip() for word in words if word.strip() and not word.strip().endswith(":")]


def _by_names(names: list[str]) -> Columns | None:
    """The columns with these names, None if a part of the pose is not among them."""
    time = next((place for place, name in enumerate(names) if _TIME.match(name)), None)
    axes: dict[str, int] = {}
    quats: dict[str, int] = {}
    for place, name in enumerate(names):
        quat, position = QUATERNION_NAME.match(name), _POSITION.match(name)
        if quat is not None:
            quats.setdefault(quat[1].lower(), place)
        elif position is not None:
            axes.setdefault(position[1].lower(), place)
    if time is None or len(axes) != len("xyz") or len(quats) not in {0, 4}:
        return None
    position_places = tuple(axes[axis] for axis in "xyz")
    # They are read in the order x y z w wherever they stand.
    orientation = tuple(quats[axis] for axis in "xyzw") if quats else ()
    return Columns(len(names), time, position_places, orientation, QuaternionOrder.XYZW if quats else None)


# Files of poses in any of the common formats: the layout of rows, unit of times and order of quaternions.


_POSITION_COLUMNS, _TUM_COLUMNS, _KITTI_COLUMNS, _EUROC_COLUMNS = 4, 8, 12, 17
_FIRST_NANOSECONDS = 1e11
"""100 s; as seconds it would be three thousand years. Such rows may go on behind the pose, as those of EuRoC do."""

_TOLD = "as specified"
_HEADER = "by its header"

_Choice = TypeVar("_Choice", TimeUnit, QuaternionOrder)


class TrajectoryFormat(StrEnum):
    """The format of a trajectory; ``auto`` detects it. :data:`.formats.FORMATS` says who writes which."""

    AUTO = "auto"
    TUM = "tum"
    KITTI = "kitti"
    EUROC = "euroc"
    COLMAP = "colmap"
    G2O = "g2o"
    BOREAS = "boreas"
    NUSCENES = "nuscenes"
    NCLT = "nclt"
    TARTANAIR = "tartanair"
    REPLICA = "replica"
    FAST_LIO = "fast-lio"
    POSE_FOLDER = "pose-folder"


_UNITS = {TrajectoryFormat.TUM: TimeUnit.S, TrajectoryFormat.EUROC: TimeUnit.NS}
_ORDERS = {TrajectoryFormat.TUM: QuaternionOrder.XYZW, TrajectoryFormat.EUROC: QuaternionOrder.WXYZ}


@dataclass(frozen=True, slots=True)
class PoseFile:
    """A file of poses that was read, with its conventions not yet known.

    Attributes:
        data: Its bytes.
        format: The layout of its rows: TUM for eight columns or four, EUROC for more, KITTI for matrices; or another.
        raw: Its numbers.
        named: The user has specified the format.
        plain: The rows of a TUM file are just the pose, so the file can be kept as it is.
    """

    data: bytes
    format: TrajectoryFormat
    raw: RawPoses
    named: bool = False
    plain: bool = True

    @property
    def has_order(self) -> bool:
        """Tell if the file has quaternions: files of positions or matrices have none."""
        return self.raw.orientations and self.format in {TrajectoryFormat.TUM, TrajectoryFormat.EUROC}

    def unit(self, told: Convention, other: Span | None, what: str = "the ground truth") -> Conclusion[TimeUnit]:
        """The unit of its times: as specified, stated or found.

        ``other`` is the time in s that it should share, and ``what`` has that time.
        """
        if told.time_unit is not None:
            return Conclusion(told.time_unit, _TOLD)
        stated = None
        if self.named and self.format in _UNITS:
            stated = Conclusion(_UNITS[self.format], f"by --format {self.format}")
        elif self.raw.stated.time_unit is not None:
            stated = Conclusion(self.raw.stated.time_unit, _HEADER)
        return find_unit(self.raw.times, stated, other, what)

    def order(
        self, told: Convention, unit: TimeUnit, spreads_deg: Mapping[QuaternionOrder, float]
    ) -> Conclusion[QuaternionOrder]:
        """The order of its quaternions: as specified, stated or found; see :func:`.evidence.find_order`."""
        if told.quaternion_order is not None:
            return Conclusion(told.quaternion_order, _TOLD)
        return find_order(self.raw.quats, self.stated_order(unit), spreads_deg)

    def stated_order(self, unit: TimeUnit) -> Conclusion[QuaternionOrder] | None:
        """The quaternion order as specified by the user, the header, or a format that has only one."""
        if self.named:
            return Conclusion(_ORDERS[self.format], f"by --format {self.format}")
        if self.raw.stated.quaternion_order is not None:
            return Conclusion(self.raw.stated.quaternion_order, _HEADER)
        if self.format is TrajectoryFormat.EUROC:
            return Conclusion(QuaternionOrder.WXYZ, "as in EuRoC's own files")
        # Eight columns with seconds are a TUM file; with another unit they could be anything.
        return Conclusion(QuaternionOrder.XYZW, "as in TUM files") if unit is TimeUnit.S else None


def read_pose_file(
    path: Path, wanted: TrajectoryFormat, times: Path | None, *, positions: bool = False, columns: str | None = None
) -> PoseFile:
    """Read the numbers of a file of poses.

    Args:
        path: The file.
        wanted: Its format; AUTO detects it.
        times: The file of the timestamps, for KITTI poses.
        positions: Four columns are a timestamp and a position.
        columns: What the columns hold, see :func:`.columns.stated_columns`; None to find out.

    Raises:
        NotFound: There is no such file.
        InvalidInput: It is damaged; names file, line and value.
    """
    file = _rows(path, wanted, times, positions=positions, columns=columns)
    refuse_keys(file.raw.times, str(path))
    # Damage is reported before any doubt about units.
    file.raw.trajectory(TimeUnit.S, QuaternionOrder.XYZW, Duplicates.KEEP)
    return file


def read_ground_truth(path: Path, recorded: Span) -> tuple[Trajectory, bool]:
    """The ground truth of a recording, and whether its orientations are known; of equal timestamps, the first counts.

    Args:
        path: A file in TUM or EuRoC format, or of timestamps and positions.
        recorded: When the recording begins and ends, in s: it shows the unit of the timestamps.

    Raises:
        NotFound: There is no such file.
        InvalidInput: It is damaged, or its conventions are in doubt.
    """
    file = read_pose_file(path, TrajectoryFormat.AUTO, None, positions=True)
    unit = decided(file.unit(UNKNOWN, recorded), f"{path}: the time unit", "write it in seconds, in TUM format")
    order = QuaternionOrder.XYZW
    if file.has_order:
        found = file.order(UNKNOWN, unit, {})
        order = decided(found, f"{path}: the quaternion order", "write it as x y z w with seconds, in TUM format")
    return file.raw.trajectory(unit, order, Duplicates.FIRST), file.raw.orientations


def decided(finding: Conclusion[_Choice], what: str, remedy: str) -> _Choice:
    """The value of a finding; raises InvalidInput with its evidence if it is in doubt."""
    if finding.value is None:
        raise InvalidInput(f"{what} is in doubt: {finding.because}", remedy)
    return finding.value


def _rows(
    path: Path, wanted: TrajectoryFormat, times: Path | None, *, positions: bool, columns: str | None
) -> PoseFile:
    own = _own_format(path, wanted, times) if columns is None else None
    if own is not None:
        return own
    original = read_bounded(path)
    data = with_header_as_comment(original)
    count = count_columns(data)
    if columns is not None:
        raw = parse_columns(data, str(path), stated_columns(columns, count))
        return PoseFile(original, TrajectoryFormat.TUM, raw, plain=False)
    if positions and count == _POSITION_COLUMNS:
        return PoseFile(original, TrajectoryFormat.TUM, parse_position_rows(data, str(path)), plain=data == original)
    found = wanted if wanted is not TrajectoryFormat.AUTO else _detect(data, count)
    placed = find_columns(data) if wanted is TrajectoryFormat.AUTO else None
    # Plain: the pose stands where the format expects it, with nothing unknown behind it.
    plain = (
        placed is not None
        and (placed.time, placed.position, sorted(placed.orientation)) == (0, (1, 2, 3), [4, 5, 6, 7])
        and (found is TrajectoryFormat.EUROC or placed.count == _TUM_COLUMNS)
    )
    if placed is not None and not plain and (placed.orientation or positions):
        return PoseFile(original, TrajectoryFormat.TUM, parse_columns(data, str(path), placed), plain=False)
    if found is TrajectoryFormat.KITTI:
        if times is None:
            raise InvalidInput(
                f"{path} holds KITTI poses, which have no timestamps",
                "give a TUM file; imports of runs also take the file of the timestamps (--times)",
            )
        return PoseFile(original, found, read_kitti_rows(path, times))
    raw = parse_rows(data, str(path), more_columns=found is TrajectoryFormat.EUROC)
    return PoseFile(original, found, raw, named=wanted is found, plain=data == original)


def _own_format(path: Path, wanted: TrajectoryFormat, times: Path | None) -> PoseFile | None:
    """Read the poses of a format that has a reader of its own; None for tables of numbers with a time and a pose."""
    if path.is_dir() and wanted in {TrajectoryFormat.AUTO, TrajectoryFormat.POSE_FOLDER}:
        text, raw = read_pose_folder(path, times)
        return PoseFile(text, TrajectoryFormat.POSE_FOLDER, raw, plain=False)
    data = read_bounded(path)
    own = find_format(data) if wanted is TrajectoryFormat.AUTO else format_named(wanted)
    if own is None or own.read is None:
        return None
    return PoseFile(data, TrajectoryFormat(own.name), own.read(data, str(path), times), plain=False)


def _detect(data: bytes, columns: int) -> TrajectoryFormat:
    """The layout of the rows, without their conventions."""
    if columns == _KITTI_COLUMNS:
        return TrajectoryFormat.KITTI
    if columns == _EUROC_COLUMNS or (columns > _TUM_COLUMNS and _first_number(data) >= _FIRST_NANOSECONDS):
        return TrajectoryFormat.EUROC
    return TrajectoryFormat.TUM


def _first_number(data: bytes) -> float:
    row = next(line for line in data.splitlines() if line.strip() and not line.lstrip().startswith(b"#"))
    try:
        return float(row.replace(b",", b" ").split()[0])
    except ValueError:
        return 0.0


# Files beside a ground truth: the uncertainty of its positions, and the times of images.


def read_uncertainties(path: Path, stamps_s: FloatArray) -> FloatArray:
    """Standard deviations of true positions along x, y, z at ``stamps_s`` (n,), shape (n, 3), from rows of a file.

    They are interpolated linearly. Raises InvalidInput for a damaged file, one that ends before the ground truth, and
    standard deviations that are none.
    """
    rows = parse_table(read_bounded(path), path.name, 4, "timestamp sigma_x sigma_y sigma_z").values
    steps_s = np.diff(rows[:, 0])
    if not np.isfinite(rows).all() or (rows[:, 1:] < 0).any() or (steps_s <= 0).any():
        raise InvalidInput(
            f"{path.name} must hold growing timestamps and standard deviations of 0 or more",
            "write timestamp sigma_x sigma_y sigma_z, in s and m",
        )
    step_s = float(np.median(steps_s)) if len(steps_s) else 0.0
    if stamps_s[0] < rows[0, 0] - step_s or stamps_s[-1] > rows[-1, 0] + step_s:
        raise InvalidInput(f"{path.name} does not cover the ground truth", "write a row for each of its poses")
    return np.column_stack([np.interp(stamps_s, rows[:, 0], rows[:, axis]) for axis in (1, 2, 3)])


def read_times(path: Path) -> FloatArray:
    """The growing timestamps in s of a file with one a line, shape (n,); raises InvalidInput for other content."""
    times_s = parse_table(read_bounded(path), path.name, 1, "timestamp").values[:, 0]
    if not np.isfinite(times_s).all() or (np.diff(times_s) <= 0).any():
        raise InvalidInput(f"{path.name} must hold growing timestamps", "write one of each image, in s")
    return times_s


def read_image_times(path: Path, truth: Span) -> FloatArray:
    """Times of images, in s, increasing, shape (n,).

    Args:
        path: Lines that begin with a timestamp, alone or before a file name: ``rgb.txt`` of TUM and ETH3D, ``data.csv``
            of EuRoC.
        truth: When the ground truth begins and ends, in s; it shows the unit of the timestamps.

    Raises:
        NotFound: There is no such file.
        InvalidInput: A line begins with no timestamp, their unit is in doubt, or none is within the ground truth.
    """
    found: list[float] = []
    for number, line in enumerate(text_lines(read_bounded(path), str(path), "timestamp and file name"), start=1):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        try:
            time = float(words[0])
        except ValueError:
            time = np.nan
        if not np.isfinite(time):
            raise InvalidInput(
                f"{path}, line {number}: {words[0][:40]!r} is not a timestamp",
                "begin each line with the timestamp of an image",
            )
        found.append(time)
    if not found:
        raise InvalidInput(f"{path} names no image", "begin each line with the timestamp of an image")
    times = np.unique(found)
    unit = decided(find_unit(times, None, truth), f"{path}: the time unit", "write the timestamps in seconds")
    times_s = times / unit.per_second
    if times_s[-1] < truth[0] or times_s[0] > truth[1]:
        raise InvalidInput(
            f"{path}: the images are from {times_s[0]:.3f} s to {times_s[-1]:.3f} s, "
            f"the ground truth is from {truth[0]:.3f} s to {truth[1]:.3f} s: the clocks do not meet",
            "give the times of the images on the clock of the ground truth",
        )
    return times_s


def format_times(times_s: FloatArray) -> bytes:
    """The text that :func:`read_times` reads: nanoseconds count."""
    return "".join(f"{time_s:.9f}\n" for time_s in times_s.tolist()).encode()
