"""What ORB-SLAM3 leaves where it loses its way."""

from __future__ import annotations

import importlib.util
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from slamhive.base.errors import InvalidInput
from slamhive.base.project import project_root

LIMIT_S = 0.3


@pytest.fixture
def module() -> ModuleType:
    path = project_root() / "algorithms" / "orb-slam3" / "slamhive" / "orb_trajectory.py"
    found = importlib.util.spec_from_file_location("orb_trajectory", path)
    assert found is not None
    assert found.loader is not None
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    return module


class Ended:
    """A system after its shutdown, with keyframes in its current map and in the older ones."""

    def __init__(self, current: int, older: int, saving: Callable[[], None] = lambda: None) -> None:
        self._current = current
        self._older = older
        self._saving = saving

    def save_keyframe_trajectory_tum(self, path: str) -> None:
        Path(path).write_text("1 0 0 0 0 0 0 1\n" * self._current)

    def save_trajectory_euroc(self, path: str) -> None:
        os.write(1, f"  Map 0 has {self._older} KFs\n  Map 1 has {self._current} KFs\n".encode())
        self._saving()
        Path(path).write_text("1 0 0 0 0 0 0 1\n")


def hang() -> None:
    time.sleep(60)


def crash() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def complain() -> None:
    raise RuntimeError("Invalid argument")


def test_the_last_pose_is_kept_once_however_often_it_is_repeated(module: ModuleType) -> None:
    stamps = [10.0, 20.0, 20.0, 20.0, 30.0, 40.0, 40.0]
    table = np.column_stack([stamps, *[np.arange(7.0)] * 7])
    kept = module.without_repeats(table)
    assert kept[:, 0].tolist() == [10.0, 20.0, 30.0, 40.0]
    assert kept[:, 1].tolist() == [0.0, 1.0, 4.0, 5.0]


@pytest.mark.integration
@pytest.mark.parametrize(("current", "older"), [(3, 0), (0, 12), (3, 12)])
def test_a_map_with_keyframes_is_saved_also_if_it_is_not_the_current_one(
    module: ModuleType, tmp_path: Path, current: int, older: int
) -> None:
    path = module.save_trajectory(Ended(current, older), tmp_path)
    assert path.read_text() == "1 0 0 0 0 0 0 1\n"


@pytest.mark.integration
@pytest.mark.parametrize("saving", [hang, crash, complain])
def test_without_a_keyframe_there_is_no_trajectory_and_an_end(
    module: ModuleType, tmp_path: Path, saving: Callable[[], None]
) -> None:
    began_s = time.monotonic()
    assert module.save_trajectory(Ended(0, 0, saving), tmp_path, LIMIT_S) is None
    assert time.monotonic() - began_s < 10


@pytest.mark.integration
@pytest.mark.parametrize("saving", [hang, crash])
def test_keyframes_that_cannot_be_saved_are_no_empty_map(
    module: ModuleType, tmp_path: Path, saving: Callable[[], None]
) -> None:
    with pytest.raises(InvalidInput, match="has keyframes, but did not save"):
        module.save_trajectory(Ended(0, 12, saving), tmp_path, LIMIT_S)
