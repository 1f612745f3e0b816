"""Meanings of names and numbers in files of the field and of the published SLAM Hive."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

from slamhive.base.errors import InvalidInput

_CAMERA = {
    **{key: key for key in ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2", "width", "height")},
    "image_width": "width",
    "image_height": "height",
    "fps": "rate_hz",
    "image_frequency": "rate_hz",
    "k": "camera_matrix",
    "d": "distortion",
}
_DEPTH = {"depthmapfactor": "depth_units_per_m", "depth_factor": "depth_units_per_m"}
_IMU = {
    "noiseacc": "accelerometer_noise_density",
    "noisegyro": "gyroscope_noise_density",
    "accwalk": "accelerometer_random_walk",
    "gyrowalk": "gyroscope_random_walk",
    "imu_frequency": "rate_hz",
    "imu_rate": "rate_hz",
}
_LIDAR = {
    "n_scan": "beams",
    "scan_line": "beams",
    "horizon_scan": "points_per_ring",
    "minimum_range": "minimum_range_m",
}
_POSES = {
    "body_t_cam0": "imu.T(left)",
    "body_t_cam1": "imu.T(right)",
    "t_b_c1": "imu.T(left)",
    "t_b_c0": "imu.T(left)",
    "tbc": "imu.T(left)",
    "bf": "left.bf(right)",
}
_SIDES = (
    ("right", re.compile(r"^(?:cam1|right|camera1|image1)_?(?=[a-z])")),
    ("left", re.compile(r"^(?:cam0|left|camera0|camera|image0)_?(?=[a-z])")),
)
_WHOLE = frozenset({"width", "height", "beams", "points_per_ring"})
_MATRICES = frozenset({"camera_matrix", "distortion", "T"})

_EXAMPLES: dict[str, tuple[str, dict[str, int | float]]] = {
    "ORB-SLAM2 and ORB-SLAM3": (
        "nFeatures",
        {
            "nFeatures": 1000,
            "scaleFactor": 1.2,
            "nLevels": 8,
            "iniThFAST": 20,
            "minThFAST": 7,
            "ThDepth": 35.0,
            "RGB": 1,
            "KeyFrameSize": 0.05,
            "KeyFrameLineWidth": 1,
            "GraphLineWidth": 0.9,
            "PointSize": 2,
            "CameraSize": 0.08,
            "CameraLineWidth": 3,
            "ViewpointX": 0,
            "ViewpointY": -0.7,
            "ViewpointZ": -1.8,
            "ViewpointF": 500,
        },
    ),
    "VINS-Mono and VINS-Fusion": (
        "max_cnt",
        {
            "max_cnt": 150,
            "min_dist": 30,
            "freq": 10,
            "F_threshold": 1.0,
            "show_track": 0,
            "flow_back": 1,
            "max_solver_time": 0.04,
            "max_num_iterations": 8,
            "keyframe_parallax": 10.0,
            "estimate_extrinsic": 0,
            "acc_n": 0.1,
            "gyr_n": 0.01,
            "acc_w": 0.001,
            "gyr_w": 0.0001,
            "estimate_td": 0,
            "td": 0.0,
            "g_norm": 9.81007,
            "equalize": 1,
            "fisheye": 0,
            "loop_closure": 1,
        },
    ),
}
_GENERAL = {"nFeatures": "features", "max_cnt": "features"}


def source_of(name: str, roles: Collection[str]) -> tuple[str, str] | None:
    """The property of a sensor that a parameter means (``left.fx``), and the type of its value; None if none.

    Args:
        name: The parameter, for instance ``cam1_fx``, ``LEFT_K`` or ``acc_n``.
        roles: The roles of the mode; a property of another role is none.
    """
    lower = name.lower()
    if lower in _POSES:
        wanted = set(re.findall(r"left|right|imu", _POSES[lower]))
        if wanted <= set(roles):
            return _POSES[lower], "float" if lower == "bf" else "matrix"
        return None
    sides = ((role, lower[found.end() :]) for role, form in _SIDES if (found := form.match(lower)))
    side, key = next(sides, ("", lower))
    if len(key) == 1 and not side:
        return None
    for role, known in ((side or "left", _CAMERA), ("depth", _DEPTH), ("imu", _IMU), ("points", _LIDAR)):
        if key in known and role in roles:
            return f"{role}.{known[key]}", _type_of(known[key])
    return None


def example_of(name: str, names: Collection[str]) -> tuple[int | float, str] | None:
    """The value of a parameter in the example files of the system that ``names`` belong to, and that system."""
    for system, (mark, values) in _EXAMPLES.items():
        if mark in names and name in values:
            return values[name], system
    return None


def general_name(name: str) -> str | None:
    """The name of a parameter across algorithms."""
    return _GENERAL.get(name)


def _type_of(key: str) -> str:
    if key in _MATRICES:
        return "matrix"
    return "int" if key in _WHOLE else "float"


# Meanings of the numbers in files of the published SLAM Hive.
#
# Its files name algorithms, datasets, experiments (combinations) and configurations by their numbers in the database of
# their installation. In another installation the same number is something else. So a number is taken only if the file
# or its user says what it means. Every list of runs imports this module, so it reads no files.


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
