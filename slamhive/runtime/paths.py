"""The paths of a run: those of the container contract, or those that the process executor sets."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from slamhive.base.errors import InvalidInput

CONFIG_VARIABLE = "SLAMHIVE_CONFIG"
DATASET_VARIABLE = "SLAMHIVE_DATASET"
RESULT_VARIABLE = "SLAMHIVE_RESULT"
WEIGHTS_VARIABLE = "SLAMHIVE_WEIGHTS"
"""Names the folder with the weights that the package lists."""
ORB_VOCABULARY_VARIABLE = "SLAMHIVE_ORB_VOCABULARY"
"""Names the ORB vocabulary file to use in place of the small one that comes with the package."""

MAP_VARIABLE = "SLAMHIVE_MAP"
"""Names the map that the run starts with, a read-only file; not set for a run without one."""

TRAJECTORY_FILES = {"live": "traj.live.txt", "final": "traj.final.txt", "keyframes": "keyframe.txt"}
"""The files in the result folder with trajectories other than ``traj.txt``, by kind."""


@dataclass(frozen=True, slots=True)
class RunPaths:
    """The configuration file, the folder with the recording, the folder for the results."""

    config: Path
    dataset: Path
    result: Path


def run_paths(environment: Mapping[str, str] = os.environ) -> RunPaths:
    """The paths of this run: ``/slamhive/...`` unless ``environment`` names others."""
    return RunPaths(
        config=Path(environment.get(CONFIG_VARIABLE, "/slamhive/config.yaml")),
        dataset=Path(environment.get(DATASET_VARIABLE, "/slamhive/dataset")),
        result=Path(environment.get(RESULT_VARIABLE, "/slamhive/result")),
    )


def is_recording(entry: Path) -> bool:
    """Tell if ``entry`` looks like a recording: a ``.bag``, ``.mcap`` or ``.db3`` file, or a folder of ROS 2."""
    return entry.suffix in {".bag", ".mcap", ".db3"} or (entry / "metadata.yaml").is_file()


def find_recording(folder: Path) -> Path:
    """The only recording in ``folder``: a ``.bag``, an ``.mcap``, or a folder with ``metadata.yaml`` (ROS 2).

    Raises InvalidInput if there is none or more than one.
    """
    try:
        entries = sorted(folder.iterdir())
    except OSError as error:
        raise InvalidInput(f"{folder} cannot be read: {error.strerror}") from None
    found = [entry for entry in entries if is_recording(entry)]
    if len(found) != 1:
        names = ", ".join(entry.name for entry in found) or "none"
        raise InvalidInput(f"expected one recording in {folder}, found {names}", "a .bag, an .mcap or a ROS 2 folder")
    return found[0]


def weights_file(name: str, environment: Mapping[str, str] = os.environ) -> Path:
    """The file with the weights ``name``; raises InvalidInput if the run was started without it."""
    path = Path(environment.get(WEIGHTS_VARIABLE, "/slamhive-weights")) / name
    if not path.is_file():
        raise InvalidInput(
            f"the weights {path} are missing", "add them: slamhive algorithm weights PACKAGE --file FILE"
        )
    return path
