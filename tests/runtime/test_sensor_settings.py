"""Settings files for OpenCV, calibration by role and the ORB vocabulary, as packages write them."""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from slamhive.base.errors import InvalidInput
from slamhive.runtime.calibration import EQUIDISTANT, RADTAN, camera_matrix, check_model, distortion, transform
from slamhive.runtime.opencv_yaml import opencv_yaml, real
from slamhive.runtime.orb_vocabulary import about_vocabulary, vocabulary_path
from slamhive.runtime.trajectory import Poses, read_poses, write_trajectory

TURNED = [0.0, -1, 0, 0.1, 1, 0, 0, 0.2, 0, 0, 1, 0.3, 0, 0, 0, 1]
BYTES = " ".join(["7"] * 32)
VOCABULARY = f"10 6 0 0\n0 0 {BYTES} 0\n1 1 {BYTES} 0.5 \n1 1 {BYTES} 0.5\n"
VALUES: dict[str, Any] = {
    "left_fx": 460,
    "left_fy": 461.5,
    "left_cx": 320,
    "left_cy": 240,
    "left_model": "pinhole-radtan",
    "left_distortion": [-0.3, 0.1, 0.001, 0.0002],
    "left_T_body_sensor": TURNED,
    "imu_T_body_sensor": np.eye(4).reshape(-1).tolist(),
}


def test_opencv_reads_what_was_written(tmp_path: Path) -> None:
    T = np.array(TURNED).reshape(4, 4)
    values = {"rate": 20.0, "tiny": 1.25e-12, "count": 500, "on": True, "topic": "/left", "T": T, "lens": {"k1": -3e-5}}
    path = tmp_path / "settings.yaml"
    path.write_text(opencv_yaml(values))
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    assert file.getNode("rate").isReal()
    assert file.getNode("rate").real() == 20
    assert file.getNode("tiny").real() == 1.25e-12
    assert file.getNode("count").isInt()
    assert file.getNode("on").real() == 1
    assert file.getNode("topic").string() == "/left"
    assert np.array_equal(file.getNode("T").mat(), T)
    assert file.getNode("lens").getNode("k1").real() == -3e-5


def test_a_real_number_has_a_decimal_point() -> None:
    assert [real(value) for value in (500, 0.5, 1e-7, 1e300)] == ["500.0", "0.5", "1.0e-07", "1.0e+300"]


def test_calibration_is_found_by_role() -> None:
    assert camera_matrix(VALUES, "left").tolist() == [[460, 0, 320], [0, 461.5, 240], [0, 0, 1]]
    assert distortion(VALUES, "left") == [-0.3, 0.1, 0.001, 0.0002]
    assert distortion({"left_distortion": [0.0] * 4}, "left") == []
    assert np.allclose(transform(VALUES, "imu", "left"), np.array(TURNED).reshape(4, 4))


def test_a_lens_that_a_system_cannot_describe_is_refused() -> None:
    check_model(VALUES, "left", RADTAN, 5, "ORB-SLAM2")
    check_model({"left_model": "double-sphere", "left_distortion": [0.0, 0.0]}, "left", RADTAN, 5, "ORB-SLAM2")
    with pytest.raises(InvalidInput, match="no camera model for the images of left: pinhole-radtan with 4"):
        check_model(VALUES, "left", EQUIDISTANT, 4, "VINS-Mono")


def test_the_vocabulary_is_the_users_or_the_small_one(tmp_path: Path) -> None:
    (tmp_path / "small_vocabulary.txt").write_text(VOCABULARY)
    small = {"SLAMHIVE_PREPARED": str(tmp_path)}
    path = vocabulary_path(small)
    assert about_vocabulary(path, small)["words"] == 2
    assert about_vocabulary(path, small)["name"].startswith("small")
    own = {"SLAMHIVE_ORB_VOCABULARY": str(path)}
    assert vocabulary_path(own) == path
    assert about_vocabulary(path, own)["name"] == "small_vocabulary.txt"
    with pytest.raises(InvalidInput, match="does not exist"):
        vocabulary_path({"SLAMHIVE_ORB_VOCABULARY": str(tmp_path / "none.txt")})


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"", "its first line is not branching, depth, scoring and weighting; give ORBvoc.txt"),
        (b"10 6 0 0\n", "its first line is not"),
        (b"%YAML:1.0\n---\nvocabulary:\n", "its first line is not"),
        (b"\x0a\x00\x00\x00\x06\x00\x00\x00", "it is binary; give the text file"),
        (gzip.compress(VOCABULARY.encode()), "it is compressed; unpack it"),
        (VOCABULARY.replace(BYTES, f"{BYTES} {BYTES}").encode(), "its descriptors have 64 bytes; .* have 32"),
        (VOCABULARY.encode()[:-40], "line 4 has 1[0-9] numbers instead of 35; the file is incomplete"),
        (
            VOCABULARY.replace("\n1 1", "\n0 0", 1).encode(),
            "1 of its nodes have no words below them; the file is incomplete",
        ),
        (VOCABULARY.replace("\n1 1", "\n7 1", 1).encode(), "node 2 comes before its parent 7; damaged"),
        (VOCABULARY.replace("\n1 1", "\nx 1", 1).encode(), "node 2 comes before its parent x; damaged"),
    ],
)
def test_a_vocabulary_that_does_not_fit_is_refused_in_one_line(content: bytes, problem: str, tmp_path: Path) -> None:
    path = tmp_path / "voc.txt"
    path.write_bytes(content)
    with pytest.raises(InvalidInput, match=rf"voc\.txt is no ORB vocabulary: {problem}") as refused:
        about_vocabulary(path, {})
    assert "\n" not in str(refused.value)


def test_poses_that_a_program_saved_are_read_back(tmp_path: Path) -> None:
    T = np.stack([np.array(TURNED).reshape(4, 4), np.eye(4)])
    write_trajectory(tmp_path / "traj.txt", Poses(np.array([1.5, 2.5]), T))
    read = read_poses((tmp_path / "traj.txt").read_text())
    assert read.stamps_s.tolist() == [1.5, 2.5]
    assert np.allclose(read.T_world_sensor, T)
    assert read_poses("").T_world_sensor.shape == (0, 4, 4)
    with pytest.raises(InvalidInput, match="not in TUM format"):
        read_poses("1 2 3\n")
