"""Folders of the published kind are read as text, and become packages."""

from __future__ import annotations

import contextlib
import random
import subprocess
import sys
from pathlib import Path

import pytest

from slamhive.base.errors import InvalidInput, SlamHiveError
from slamhive.documents.submission import Submission
from slamhive.domain.algorithm import Algorithm, Base, RunUser
from slamhive.domain.dataset import Dataset
from slamhive.domain.packages import PackageOrigin
from slamhive.domain.protocol import TrajectoryKind
from slamhive.domain.sensors import CalibrationValue, Sensor, SensorKind, SensorSetup
from slamhive.executors.docker.containers import HANDOVER
from slamhive.executors.docker.foreign_images import PROBE, own_yaml
from slamhive.packages.algorithm_file import load_algorithms
from slamhive.packages.published.draft import DraftRequest, PackageDraft, draft, licence_of
from slamhive.packages.published.facts import find_facts
from slamhive.packages.published.folder import MOST_TEXT_BYTES, copy_scripts, read_folder
from slamhive.packages.published.script import read_script
from slamhive.packages.run_config import build_run_config
from tests.foreign import folders
from tests.fuzzing import mutated

pytestmark = pytest.mark.integration

ORIGIN = PackageOrigin("https://example.org/slam/x", commit="0123456789abcdef")


def drafted(path: Path, setup: SensorSetup | None = None, image_user: str | None = None) -> PackageDraft:
    folder = read_folder(path)
    return draft(folder, find_facts(folder), DraftRequest(path.name, ORIGIN, setup, image_user))


def package(path: Path) -> Algorithm:
    (path / "algorithm.yaml").write_text(drafted(path).text)
    (algorithm,) = load_algorithms(path)
    return algorithm


def test_a_template_becomes_parameters_that_the_dataset_fills(tmp_path):
    algorithm = package(folders.orb_slam2(tmp_path))
    sources = {entry.key: str(entry.source) for entry in algorithm.parameters if entry.source}
    assert sources == {
        **{key: f"left.{key}" for key in ("fx", "fy", "cx", "cy", "width", "height")},
        "fps": "left.rate_hz",
    }
    known = {entry.key: (entry.default, entry.general) for entry in algorithm.parameters if not entry.source}
    assert known == {"nFeatures": (1000, "features"), "gain": (None, None)}
    assert algorithm.setup is SensorSetup.MONO
    (topic,) = algorithm.topics
    assert topic.words == "the recording is played as /left (launch argument mono_topic)"
    assert algorithm.package.origin == ORIGIN
    assert algorithm.package.base is Base.ROS1
    assert algorithm.trajectory is TrajectoryKind.KEYFRAMES
    assert algorithm.unknown == ("licence", "citation", "default of gain")
    assert algorithm.parameters[0].help == "focal length in pixels"


def test_calibration_is_that_of_the_dataset_and_its_variant(tmp_path):
    """The published defaults are EuRoC's; at half size they would be wrong by a factor of two."""
    algorithm = package(folders.orb_slam2(tmp_path))
    for scale in (1.0, 0.5):
        calibration: dict[str, CalibrationValue] = {"width": int(640 * scale), "height": int(480 * scale)}
        calibration |= {"fx": 400.0 * scale, "fy": 401.0 * scale, "cx": 320.0 * scale, "cy": 240.0 * scale}
        camera = Sensor("cam0", SensorKind.CAMERA, "/cam0/image_raw", 20.0, calibration=calibration)
        seen = Dataset("room", tmp_path, "room.bag", 10.0, (camera,), None, "sha256:0")
        configuration = Submission(algorithm.name, "room", {"gain": "1"}).configuration(algorithm)
        config = build_run_config(algorithm, seen, configuration, None, 0)
        assert config.algorithm_parameters["fx"] == 400.0 * scale
        assert config.algorithm_parameters["width"] == int(640 * scale)
        assert config.algorithm_parameters["fps"] == 20.0
        assert config.algorithm_remap == {"mono_topic": "/left"}
        assert config.dataset_remap == {"/left": "/cam0/image_raw"}


def test_what_runs_in_old_images_keeps_to_their_python(tmp_path):
    (tmp_path / "probe.py").write_text(PROBE)
    (tmp_path / "handover.py").write_text(HANDOVER)
    vermin = [str(Path(sys.executable).with_name("vermin")), "--target=3.5-", "--no-tips", "--violations"]
    paths = [str(tmp_path / "probe.py"), str(tmp_path / "handover.py"), *map(str, sorted(own_yaml().glob("*.py")))]
    found = subprocess.run([*vermin, *paths], check=False, capture_output=True, text=True, timeout=60)
    assert found.returncode == 0, found.stdout + found.stderr


def test_topics_that_are_parameters_and_templates_of_two_levels(tmp_path):
    algorithm = package(folders.vins(tmp_path))
    assert algorithm.setup is SensorSetup.STEREO_INERTIAL
    assert {entry.role: entry.parameter for entry in algorithm.topics} == {
        "imu": "imu_topic",
        "left": "image0_topic",
        "right": "image1_topic",
    }
    found = {entry.key: str(entry.source or entry.default) for entry in algorithm.parameters}
    assert found["cam1_fx"] == "right.fx"
    assert found["body_T_cam0"] == "imu.T(left)"
    assert found["cam0_calib"] == "cam0_pinhole.yaml"
    assert found["max_cnt"] == "150"
    assert found["image0_topic"] == "/left"


def test_templates_of_a_camera_are_its_choices(tmp_path):
    path = folders.write(folders.vins(tmp_path), template_cam0_mei__yaml="xi: $cam0_xi\n")
    (calib,) = (entry for entry in package(path).parameters if entry.key == "cam0_calib")
    assert (calib.choices, calib.default) == (("cam0_mei.yaml", "cam0_pinhole.yaml"), None)
    algorithm = package(path)
    with pytest.raises(InvalidInput, match=r"cam0_calib.*one of cam0_mei\.yaml, cam0_pinhole\.yaml"):
        Submission(algorithm.name, "room", {"cam0_calib": "cam0_fisheye.yaml"}).configuration(algorithm)


def test_a_camera_whose_template_is_missing_is_named(tmp_path):
    reads = folders.VINS_MAPPING + '\nopen("/slamhive/template_" + values["cam1_calib"])\n'
    template = folders.VINS_TEMPLATE + 'cam1_calib: "$cam1_calib"\n'
    path = folders.write(folders.vins(tmp_path), template__yaml=template, mapping__py=reads)
    with pytest.raises(InvalidInput, match=r"cam1_calib chooses a file template_cam1_NAME\.yaml, but .* holds none"):
        package(path)


def test_launch_arguments_and_a_fixed_topic(tmp_path):
    algorithm = package(folders.loam(tmp_path))
    assert {entry.key: entry.default for entry in algorithm.parameters} == {"scanPeriod": 0.1, "lidar": "HDL-64E"}
    assert algorithm.inputs[0].kind is SensorKind.LIDAR
    assert algorithm.topics[0].fixed == "/points_raw"


def test_values_of_examples_in_the_folder_are_taken(tmp_path):
    path = folders.orb_slam2(tmp_path, mappingtask__yaml="ORBextractor.nFeatures: 1500\nOwn.gain: 0.5  # tuned\n")
    assert {entry.key: entry.default for entry in package(path).parameters if entry.default is not None} == {
        "nFeatures": 1500,
        "gain": 0.5,
    }
    folders.write(path, config_temp__yaml="algorithm-parameters:\n  gain: 0.25\n  nFeatures: 2000\n")
    assert package(path).parameters[-1].default == 0.25


@pytest.mark.parametrize(
    ("dockerfile", "image_user", "expected"),
    [
        (folders.DOCKERFILE, None, RunUser.ROOT),
        ("FROM x\nUSER ubuntu\nRUN make\n", None, RunUser.IMAGE),
        ("FROM x\nUSER ubuntu\nFROM y\nRUN make -C /opt\n", None, RunUser.WORKER),
        ("FROM x\n", "1000:1000", RunUser.IMAGE),
        ("FROM x\n", "root", RunUser.WORKER),
    ],
)
def test_the_user_follows_from_the_dockerfile(tmp_path, dockerfile, image_user, expected):
    path = folders.loam(tmp_path)
    folders.write(path, Dockerfile=dockerfile)
    assert f"\nuser: {expected}  # " in drafted(path, image_user=image_user).text


def test_what_a_dockerfile_copies_and_the_folder_lacks_is_named(tmp_path):
    path = folders.orb_slam2(tmp_path)
    facts = find_facts(read_folder(path))
    assert facts.dockerfile is not None
    assert facts.dockerfile.missing == (("ORB_SLAM2", 3),)
    (path / "ORB_SLAM2").mkdir()
    steps = ["FROM x as y", "COPY --from=y /a /b", 'COPY ["ORB_SLAM2", "/b"]', "ADD https://x/y /c"]
    folders.write(path, Dockerfile="\n".join([*steps, "COPY ../z *.patch /d", "COPY $A /e", ""]))
    facts = find_facts(read_folder(path))
    assert facts.dockerfile is not None
    assert facts.dockerfile.missing == (("../z", 5), ("*.patch", 5))


@pytest.mark.parametrize(
    ("copied", "empty"),
    [
        ("COPY . /ws", (("src/ORB_SLAM2", 2), ("third_party/g2o", 2))),
        ("COPY src /ws/src", (("src/ORB_SLAM2", 2),)),
        ("COPY third_party/g2o /g2o", (("third_party/g2o", 2),)),
        ("COPY slamhive unlisted /ws/", (("unlisted", 2),)),
        ("COPY slamhive build/x /ws/", ()),
        ("COPY slamhive /slamhive", ()),
    ],
)
def test_empty_links_of_git_that_a_dockerfile_copies_are_named(tmp_path, copied, empty):
    folder = folders.orb_slam2(tmp_path / "repository")
    folders.write(folder, Dockerfile=f"FROM ubuntu\n{copied}\n")
    for place in ("src/ORB_SLAM2", "third_party/g2o", "fetched/pangolin", "unlisted", "build"):
        (folder / place).mkdir(parents=True)
    (folder / "fetched/pangolin/main.cpp").write_text("int main() {}")
    (folder / "build/x").write_text("made")
    places = ("src/ORB_SLAM2", "third_party/g2o", "fetched/pangolin", "absent")
    listed = [f'[submodule "{place}"]\n\tpath = {folder.name}/{place}\n\turl = https://example.org' for place in places]
    (folder.parent / ".gitmodules").write_text("\n".join([*listed, "\tpath = ../../../etc", "\tpath = " + "x" * 5000]))
    facts = find_facts(read_folder(folder))
    assert facts.dockerfile is not None
    assert facts.dockerfile.empty == empty


def test_older_python_is_read_by_patterns_and_said(tmp_path):
    path = folders.orb_slam2(tmp_path, mapping__py=folders.MAPPING + 'print "done", values["extra"]\n')
    result = drafted(path)
    assert any("is no Python 3 (line " in note and "python3 starts it" in note for note in result.notes)
    assert "  extra:  # mapping.py" in result.text
    assert "default of extra" in result.unknown


@pytest.mark.parametrize(
    ("files", "problem"),
    [
        ({"mapping__py": "open('/slamhive/other.yaml').read()"}, "uses /slamhive/other.yaml, but .* does not hold it"),
        ({"mapping__py": "import os\nos.system('roslaunch /slamhive/x.launch')"}, r"uses /slamhive/x\.launch"),
        ({"template__yaml": "a: $\nfx: $fx\n"}, r"slamhive/template\.yaml line 1 has a \$ without a name"),
    ],
)
def test_contradictions_between_script_and_files_are_named(tmp_path, files, problem):
    with pytest.raises(InvalidInput, match=problem):
        drafted(folders.orb_slam2(tmp_path, **files))


def test_unknown_sensors_have_to_be_said(tmp_path):
    path = folders.write(tmp_path / "thing", mapping__py="print(1)\n")
    with pytest.raises(InvalidInput, match=r"files of thing do not show its sensors.*--setup mono\|stereo"):
        drafted(path)
    result = drafted(path, SensorSetup.STEREO)
    assert result.unknown[-2:] == ("topic of left", "topic of right")
    (path / "algorithm.yaml").write_text(result.text)
    assert load_algorithms(path)[0].unknown == ("licence", "citation", "topic of left", "topic of right")


def test_links_and_strange_files_are_not_copied(tmp_path):
    path = folders.loam(tmp_path)
    (path / "slamhive" / "passwd").symlink_to("/etc/passwd")
    (path / "slamhive" / "up").symlink_to("../..")
    (path / "slamhive" / "tool.sh").write_text("x")
    (path / "slamhive" / "tool.sh").chmod(0o4755)
    folder = read_folder(path)
    assert folder.notes == ("not copied, since they are no plain files: passwd, up",)
    copy_scripts(path, tmp_path / "copy")
    assert sorted(entry.name for entry in (tmp_path / "copy").iterdir()) == ["loam.launch", "mapping.py", "tool.sh"]
    assert (tmp_path / "copy" / "tool.sh").stat().st_mode & 0o7777 == 0o755


def test_a_mapping_script_that_is_a_link_or_no_text_is_refused(tmp_path):
    path = folders.loam(tmp_path)
    (path / "slamhive" / "mapping.py").unlink()
    (path / "slamhive" / "mapping.py").symlink_to("/etc/passwd")
    with pytest.raises(InvalidInput, match=r"holds no slamhive/mapping\.py that can be read"):
        read_folder(path)
    for content in (b"\0", b"#" * (MOST_TEXT_BYTES + 1)):
        (path / "slamhive" / "mapping.py").unlink()
        (path / "slamhive" / "mapping.py").write_bytes(content)
        with pytest.raises(InvalidInput):
            read_folder(path)


@pytest.mark.parametrize("text", ["(" * 100_000, "-" * 500_000 + "1", "x = [" * 3000, "\0", "x['a'" * 20_000])
def test_scripts_that_no_parser_survives_are_read(text):
    assert read_script(text).problem


def test_nothing_in_a_name_or_comment_gets_into_the_yaml(tmp_path):
    template = 'a: $fx  # "]}\n# x: &a [*a]\n\tb: $evil # \x1b[31m\u2028 <script>\n'
    path = folders.orb_slam2(tmp_path, template__yaml=template)
    evil = path.with_name("x")
    path.rename(evil)
    algorithm = package(evil)
    assert [entry.key for entry in algorithm.parameters] == ["fx", "evil", "fps"]
    assert algorithm.parameters[1].help == "[31m"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("GNU GENERAL PUBLIC LICENSE\n Version 3, 29 June 2007", "GPL-3.0-or-later"),
        ("GNU GENERAL PUBLIC LICENSE\n Version 2, June 1991", "GPL-2.0-or-later"),
        ("MIT License\n\nCopyright", "MIT"),
        ("All rights reserved.", None),
        (None, None),
    ],
)
def test_licences(text, expected):
    assert licence_of(text) == expected


def test_mutated_folders_give_a_package_or_a_reason_and_run_nothing(tmp_path):
    marker = tmp_path / "executed"
    draw = random.Random(11)
    for number in range(45):
        make = draw.choice((folders.orb_slam2, folders.vins, folders.loam))
        path = make(tmp_path / str(number))
        mapping = path / "slamhive" / "mapping.py"
        mapping.write_text(f"open({str(marker)!r}, 'w')\n" + mapping.read_text())
        for file in sorted(entry for entry in path.rglob("*") if entry.is_file()):
            if draw.random() < 0.6:
                file.write_bytes(mutated(file.read_bytes(), draw))
        with contextlib.suppress(SlamHiveError):
            package(path)
    assert not marker.exists()
