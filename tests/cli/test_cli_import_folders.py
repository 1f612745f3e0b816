"""Two commands from a folder to an ATE: ``dataset import`` and ``run --evaluate``, for EuRoC, TUM RGB-D and KITTI."""

from __future__ import annotations

import json
import textwrap
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from slamhive.cli import main
from tests.recordings.format_world import EUROC_START_NS, FORMATS, HEIGHT, WIDTH, draw, with_calibration, write
from tests.services.tiny_project import ALGORITHM, environment, make_project

pytestmark = pytest.mark.integration

MODE = """\
modes:
  mono:
    title: Test algorithm
    setup: mono
    inputs: {left: camera}
    trajectory_role: left
"""
MAPPING = """
import sys
import numpy as np
from slamhive.runtime.app import run
from slamhive.runtime.trajectory import Poses

class Slider:
    '''A camera that slides over a plane: phase correlation finds by how many pixels from image to image.'''

    def __init__(self, config):
        self.stamps_s, self.shifts, self.last = [], [np.zeros(2)], None

    def process(self, frame):
        image = frame.image("left").astype(float)
        image = image.mean(axis=2) if image.ndim == 3 else image
        spectrum = np.fft.fft2(image - image.mean())
        if self.last is not None:
            cross = spectrum.conj() * self.last
            peak = np.fft.ifft2(cross / np.maximum(np.abs(cross), 1e-9)).real
            place = np.array(np.unravel_index(peak.argmax(), peak.shape))
            size = np.array(peak.shape)
            self.shifts.append((place + size // 2) % size - size // 2)
        self.last = spectrum
        self.stamps_s.append(frame.stamp_s)
        return True

    def finish(self):
        poses = np.tile(np.eye(4), (len(self.stamps_s), 1, 1))
        poses[:, [1, 0], 3] = np.cumsum(self.shifts, axis=0)
        return Poses(np.array(self.stamps_s), poses)

    def about(self):
        return {}

sys.exit(run(Slider))
"""
PATH_PX = ((0, 0), (6, 0), (6, 5), (1, 9))
"""Column and row of the camera in the plane; a pixel is a metre."""
PLANE = np.random.default_rng(7).integers(0, 256, (HEIGHT + 20, WIDTH + 20), dtype=np.uint8)


def slide(files: list[Path]) -> None:
    for path, (column, row) in zip(files, PATH_PX, strict=True):
        draw(path, PLANE[row : row + HEIGHT, column : column + WIDTH])


def make_euroc(folder: Path) -> list[str]:
    FORMATS["euroc"](folder)
    slide(sorted((folder / "mav0/cam0/data").iterdir()))
    rows = (f"{EUROC_START_NS + 50_000_000 * n},{x},{y},0,1,0,0,0" for n, (x, y) in enumerate(PATH_PX))
    write(folder / "mav0/state_groundtruth_estimate0/data.csv", *rows)
    return [str(folder)]


def make_tum_rgbd(folder: Path) -> list[str]:
    FORMATS["tum-rgbd"](folder)
    files = sorted((folder / "rgb").iterdir())
    slide(files)
    rows = (f"{path.stem} {x} {y} 0 0 0 0 1" for path, (x, y) in zip(files, PATH_PX, strict=True))
    write(folder / "groundtruth.txt", *rows)
    (calibration,) = with_calibration(folder)["calibration"]
    return [str(folder), "--calibration", str(calibration)]


def make_kitti_odometry(folder: Path) -> list[str]:
    slide([folder / f"image_0/{number:06d}.png" for number in range(len(PATH_PX))])
    write(folder / "times.txt", *(f"{number * 0.1:e}" for number in range(len(PATH_PX))))
    write(folder / "calib.txt", "P0: 20 0 15.5 0 0 20 11.5 0 0 0 1 0")
    write(folder / "poses.txt", *(f"1 0 0 {x} 0 1 0 {y} 0 0 1 0" for x, y in PATH_PX))
    return [str(folder)]


MAKERS = {"euroc": make_euroc, "tum-rgbd": make_tum_rgbd, "kitti-odometry": make_kitti_odometry}


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The environment of commands in a project whose algorithm reads images."""
    folder = tmp_path_factory.mktemp("world")
    project = make_project(folder / "project")
    package = project / "algorithms" / "tiny"
    (package / "slamhive" / "mapping.py").write_text(textwrap.dedent(MAPPING))
    before, _, after = ALGORITHM.partition("modes:")
    (package / "algorithm.yaml").write_text(f"{before}{MODE}{after[after.index('parameters:') :]}")
    return environment(project, folder / "data")


def command(world: dict[str, str], monkeypatch: pytest.MonkeyPatch, *arguments: str) -> str:
    for key, value in world.items():
        monkeypatch.setenv(key, value)
    ended = CliRunner().invoke(main, arguments)
    assert ended.exit_code == 0, ended.stderr
    return ended.stdout


@pytest.mark.parametrize("name", MAKERS)
def test_two_commands_give_an_ate(world, monkeypatch, tmp_path, name):
    given = MAKERS[name](tmp_path / "source")
    shown = command(world, monkeypatch, "dataset", "import", *given, "--name", name)
    assert f"{name}: {name}, " in shown
    (run,) = json.loads(command(world, monkeypatch, "run", "tiny", name, "--evaluate", "--wait", "--json"))
    assert run["state"] == "succeeded"
    assert run["metrics"]["ate.rmse"]["value"] == pytest.approx(0, abs=1e-3)
