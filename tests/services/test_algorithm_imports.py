"""Importing algorithm packages of others: sources, archives, images, and a run of what was imported."""

from __future__ import annotations

import contextlib
import io
import json
import random
import shutil
import subprocess
import tarfile
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import create_autospec

import pytest
from click.testing import CliRunner

from slamhive.base.errors import Conflict, InvalidInput, NotFound, SlamHiveError, Unavailable
from slamhive.cli import main
from slamhive.documents.submission import Submission
from slamhive.domain.algorithm import AlgorithmPackage, RunUser
from slamhive.domain.configuration import PlaybackMode
from slamhive.domain.run import FailureReason, RunState
from slamhive.executors.base import ImageMissing, ImageTools
from slamhive.executors.docker.images import KEPT
from slamhive.executors.process.executor import ProcessExecutor
from slamhive.executors.registry import installation_id
from slamhive.services.algorithms import (
    ImageArchive,
    ImportedPackage,
    PackageImportRequest,
    SourceKind,
    check_folder,
    kind_of,
    opened,
    package_name,
    plan,
)
from slamhive.services.hive import Hive
from tests.foreign import folders
from tests.fuzzing import mutated
from tests.services.docker_base import project_base, run_docker
from tests.waiting import eventually

DOCKER = PackageImportRequest(executor="docker")
TOOLS = {
    "roslaunch": 'echo "$@" > /home/output/arguments',
    "rosbag": """
echo "$@" > /slamhive/result/played
if grep -q 'lidar: broken' /slamhive/config.yaml; then echo 'Error opening file' >&2; exit 1; fi
""",
}
MAPPING = (
    folders.LOAM_MAPPING
    + """
subprocess.run("bash -c 'python3 /slamhive/dataset/rosbag_play.py; true'", shell=True)
open("/slamhive/scratch", "w").write("the run has a copy of its own")
with open("/slamhive/result/traj.txt", "w") as trajectory:
    for number in range(30):
        trajectory.write("{} {} 0 0 0 0 0 1\\n".format(100 + number / 3, number))
subprocess.run("bash -c 'mv /home/output/arguments /slamhive/result/; touch /slamhive/result/finished'", shell=True)
"""
)


@pytest.mark.parametrize(
    ("source", "kind", "name"),
    [
        ("https://github.com/SLAM-Hive/loam.git", SourceKind.REPOSITORY, "loam"),
        ("git@github.com:SLAM-Hive/lio-sam", SourceKind.REPOSITORY, "lio-sam"),
        ("slam-hive-algorithm:aloam", SourceKind.IMAGE, "aloam"),
        ("registry.example:5000/team/loam@sha256:00", SourceKind.IMAGE, "loam"),
    ],
)
def test_sources_are_told_apart(source, kind, name, monkeypatch):
    assert kind_of(source) is kind
    if kind is SourceKind.IMAGE:
        with opened(source) as found:
            assert package_name(found) == name


@pytest.mark.parametrize("source", ["./nothing", "/nothing", "nothing.tar"])
def test_a_path_that_is_not_there_is_no_image(source):
    with pytest.raises(NotFound, match="does not exist"):
        kind_of(source)


@pytest.mark.parametrize("source", ["-v /:/host", "a b", "", "--upload-pack=x"])
def test_options_and_commands_are_no_sources(source):
    with pytest.raises(InvalidInput):
        kind_of(source)


def test_several_folders_are_named(tmp_path):
    folders.loam(tmp_path)
    folders.vins(tmp_path)
    with pytest.raises(InvalidInput, match="several algorithms: loam, vins-fusion-stereo-imu; import each"):
        check_folder(tmp_path)


def own_package(hive: Hive, root: Path, name: str = "other") -> Path:
    """A folder outside of the project with a copy of the package ``tiny`` under another name."""
    source = hive.catalogue.project_root / "algorithms" / "tiny"
    folder = root / "somewhere"
    shutil.copytree(source, folder)
    text = (folder / "algorithm.yaml").read_text()
    (folder / "algorithm.yaml").write_text(text.replace("package: tiny", f"package: {name}"))
    return folder


def test_a_package_of_ours_is_copied_and_built(hive: Hive, tmp_path, monkeypatch):
    """The copy is built before it is put in its place. Links are left out."""
    folder = own_package(hive, tmp_path)
    (folder / "link").symlink_to("/etc/passwd")
    built: list[Path] = []

    def build(_executor: object, package: AlgorithmPackage, _progress: object) -> str:
        assert package.folder.parent != hive.settings.algorithms_folder
        built.append(package.folder)
        return "identity"

    monkeypatch.setattr(ProcessExecutor, "build", build)
    with hive.algorithms.planned(str(folder), PackageImportRequest(executor="process")) as planned:
        assert planned.content["algorithms"] == ["other"]
        assert planned.text is not None
        made = hive.algorithms.perform(planned, lambda _line: None)
    assert [entry.name for entry in made.algorithms] == ["other"]
    assert made.notes == ("not copied, since they are no plain files: link",)
    assert len(built) == 1
    assert hive.catalogue.algorithm("other").package.folder == hive.settings.algorithms_folder / "other"
    with pytest.raises(Conflict, match="imported already"):
        with_plan(hive, str(folder), PackageImportRequest(executor="process"))
    with_plan(hive, str(folder), PackageImportRequest(executor="process", replace=True))


def test_a_package_of_ours_that_fails_to_build_leaves_nothing(hive: Hive, tmp_path, monkeypatch):
    folder = own_package(hive, tmp_path)

    def build(_executor: object, _package: object, _progress: object) -> str:
        raise ImageMissing("building other failed at step 2")

    monkeypatch.setattr(ProcessExecutor, "build", build)
    with pytest.raises(ImageMissing, match="step 2"):
        with_plan(hive, str(folder), PackageImportRequest(executor="process"))
    assert list(hive.settings.algorithms_folder.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "request_", "words"),
    [
        (
            "tiny",
            PackageImportRequest(),
            "'tiny' is the name of an algorithm here already; change it in its algorithm.yaml",
        ),
        ("other", PackageImportRequest(name="third"), "so --name third has no effect"),
        ("other", PackageImportRequest(image="a:b"), "so --image a:b has no effect"),
    ],
)
def test_names_of_packages_of_ours_are_those_of_their_files(hive: Hive, tmp_path, name, request_, words):
    with pytest.raises(SlamHiveError, match=words):
        with_plan(hive, str(own_package(hive, tmp_path, name)), request_)


@pytest.mark.quick
def test_a_repository_is_fetched_at_a_commit_without_running_its_hooks(tmp_path):
    path, marker = folders.loam(tmp_path), tmp_path / "executed"
    hook = path / ".githooks" / "post-checkout"
    hook.parent.mkdir()
    hook.write_text(f"#!/bin/sh\ntouch {marker}\n")
    hook.chmod(0o755)
    identity = ["-c", "user.name=x", "-c", "user.email=x@example.org"]
    for command in (["init", "-q"], ["add", "."], [*identity, "commit", "-qm", "first"]):
        subprocess.run(["git", "-C", str(path), *command], check=True, capture_output=True)
    commit = subprocess.run(["git", "-C", str(path), "rev-parse", "HEAD"], check=True, capture_output=True, text=True)
    with opened(f"file://{path}") as found:
        assert found.commit == commit.stdout.strip()
        assert found.path is not None
        assert (found.path / "slamhive" / "mapping.py").is_file()
    assert not marker.exists()
    for reference in ("#nothing", "#--upload-pack=x"):
        with pytest.raises((Unavailable, InvalidInput)), opened(f"file://{path}{reference}"):
            pass


@pytest.mark.quick
def test_a_password_in_an_address_is_shown_nowhere():
    with pytest.raises(Unavailable) as problem, opened("https://user:secret@localhost:9/x.git"):
        pass
    assert "secret" not in str(problem.value)
    assert "https://localhost:9/x.git cannot be fetched" in str(problem.value)


def archive(path: Path, images: int = 1) -> Path:
    manifest = [{"Config": "a.json", "RepoTags": ["slam-hive-algorithm:orb-slam3"], "Layers": []}] * images
    with tarfile.open(path, "w:gz") as tar:
        for name, content in (
            ("manifest.json", json.dumps(manifest)),
            ("index.json", json.dumps({"manifests": [{"annotations": {"io.containerd.image.name": "a:b"}}]})),
            ("repositories", "{}"),
            ("a.json", "x" * 1000),
        ):
            member = tarfile.TarInfo(name)
            member.size = len(content)
            tar.addfile(member, io.BytesIO(content.encode()))
    return path


def test_an_archive_gives_no_names_to_images(tmp_path):
    saved = ImageArchive(archive(tmp_path / "x.tar.gz"))
    saved.check()
    rewritten = b"".join(saved.chunks(lambda _line: None))
    with tarfile.open(fileobj=io.BytesIO(rewritten)) as tar:
        assert tar.getnames() == ["manifest.json", "index.json", "a.json"]
        content = [tar.extractfile(name) for name in ("manifest.json", "index.json", "a.json")]
    texts = [stream.read().decode() for stream in content if stream is not None]
    assert "orb-slam3" not in texts[0]
    assert "a:b" not in texts[1]
    assert texts[2] == "x" * 1000
    assert saved.checksum.startswith("sha256:")


def test_archives_of_no_or_several_images_are_refused(tmp_path):
    with pytest.raises(InvalidInput, match="holds 2 images"):
        ImageArchive(archive(tmp_path / "two.tar", 2)).check()
    with tarfile.open(tmp_path / "none.tar", "w"):
        pass
    with pytest.raises(InvalidInput, match="not a saved image"):
        ImageArchive(tmp_path / "none.tar").check()


def test_mutated_archives_give_a_reason(tmp_path):
    draw, whole = random.Random(5), archive(tmp_path / "whole.tar").read_bytes()
    for _ in range(60):
        broken = tmp_path / "broken.tar"
        broken.write_bytes(mutated(whole, draw))
        with contextlib.suppress(SlamHiveError):
            ImageArchive(broken).check()
            for _chunk in ImageArchive(broken).chunks(lambda _line: None):
                pass


def test_folders_without_algorithm_yaml_are_listed(hive: Hive):
    folder = folders.loam(hive.catalogue.project_root / "algorithms")
    folders.vins(hive.settings.algorithms_folder)
    problems = {entry.name: entry.problem for entry in hive.catalogue.broken()}
    assert problems["loam"] == f"{folder} has no algorithm.yaml; import it: slamhive algorithm import {folder}"
    assert "vins-fusion-stereo-imu" in problems


def test_an_executor_without_images_takes_none(hive: Hive, tmp_path):
    path = str(folders.loam(tmp_path))
    with pytest.raises(InvalidInput, match="executor process has no images; use an executor with images"):
        with_plan(hive, path, PackageImportRequest())


def with_plan(hive: Hive, source: str, request: PackageImportRequest) -> ImportedPackage:
    """Import, without asking what is planned."""
    with hive.algorithms.planned(source, request) as planned:
        return hive.algorithms.perform(planned, lambda _line: None)


def test_only_imported_packages_can_be_removed(hive: Hive):
    with pytest.raises(InvalidInput, match="tiny was not imported"):
        hive.algorithms.remove("tiny")
    with pytest.raises(InvalidInput, match="not allowed"):
        hive.algorithms.remove("../datasets")


@pytest.fixture
def engine_hive(hive: Hive, base_image: str) -> Iterator[Hive]:
    """An installation; the images that were imported into it are removed."""
    yield hive
    names = [f"slam-hive-algorithm:{folder.name}" for folder in hive.settings.algorithms_folder.glob("[!.]*")]
    kept = run_docker("images", "--format", "{{.Repository}}:{{.Tag}}", KEPT).stdout.split()
    mine = installation_id(hive.settings.data)[:8]
    for name in (*names, *(entry for entry in kept if entry.endswith(mine))):
        run_docker("rmi", "--force", name)


def built_folder(root: Path, base: str) -> Path:
    """Like loam, with a Dockerfile whose sources are there. Its ROS is two scripts that note what they are told."""
    path = folders.write(root / "loam-of-tests", mapping__py=MAPPING, loam__launch=folders.LOAM_LAUNCH)
    steps = ("COPY slamhive /slamhive", "COPY tools /usr/local/bin", "RUN mkdir -p /home/output /root/.ros")
    folders.write(path, Dockerfile="\n".join((f"FROM {base}", *steps, "")))
    (path / "tools").mkdir()
    for name, script in TOOLS.items():
        (path / "tools" / name).write_text(f"#!/bin/sh\n{script}")
        (path / "tools" / name).chmod(0o755)
    return path


@pytest.mark.docker
def test_a_build_that_is_cancelled_ends_in_the_engine_and_leaves_nothing(engine_hive: Hive, base_image: str, tmp_path):
    path = built_folder(tmp_path / "published", base_image)
    mark = f"tick-{tmp_path.name}"
    with (path / "Dockerfile").open("a") as file:
        file.write(f"RUN for number in $(seq 1 300); do echo {mark}; sleep 1; done\n")

    def running() -> bool:
        return mark in run_docker("ps", "--no-trunc", "--format", "{{.Command}}").stdout

    def cancel(line: str) -> None:
        if line.endswith(mark) and "RUN" not in line:
            assert running()
            raise SlamHiveError("cancelled")

    with engine_hive.algorithms.planned(str(path), DOCKER) as planned, pytest.raises(SlamHiveError, match="cancelled"):
        engine_hive.algorithms.perform(planned, cancel)
    eventually(lambda: not running(), "the end of the build")
    assert not (engine_hive.settings.algorithms_folder / path.name).exists()


@pytest.mark.docker
def test_a_folder_is_built_and_runs_untouched(engine_hive: Hive, base_image: str, tmp_path):
    hive, path = engine_hive, built_folder(tmp_path / "published", base_image)
    before = {entry: entry.read_bytes() for entry in path.rglob("*") if entry.is_file()}
    lines: list[str] = []
    with hive.algorithms.planned(str(path), DOCKER) as planned:
        made = hive.algorithms.perform(planned, lines.append)
    (algorithm,) = made.algorithms
    assert any("Step 1/4" in line for line in lines)
    assert any("put on top of the image" in note and "PyYAML" in note for note in made.notes)
    assert algorithm.package.user is RunUser.ROOT
    assert algorithm.package.origin is not None
    assert algorithm.package.origin.added == ("PyYAML",)
    with pytest.raises(Conflict, match="was imported already"):
        with_plan(hive, str(path), DOCKER)
    asked = [
        Submission("loam-of-tests", "track", {"lidar": value}, executor="docker", evaluate=False)
        for value in ("VLP-16", "broken")
    ]
    with pytest.raises(InvalidInput, match="cannot be played sequential"):
        hive.runs.submit(Submission("loam-of-tests", "track", executor="docker", playback_mode=PlaybackMode.SEQUENTIAL))
    named = PackageImportRequest("by-image", executor="docker")
    from_image = with_plan(hive, "slam-hive-algorithm:loam-of-tests", named).algorithms[0]
    assert from_image.parameters == algorithm.parameters
    scripts = from_image.package.folder / "slamhive"
    assert (scripts / "mapping.py").read_bytes() == (path / "slamhive" / "mapping.py").read_bytes()
    good, failed = (hive.runs.submit(entry)[0].id for entry in asked)
    hive.worker().run(until_idle=True)
    result = hive.settings.runs_folder / str(good) / "result"
    assert hive.runs.get(good).state is RunState.SUCCEEDED, hive.runs.get(good).detail
    told = (result / "arguments").read_text().split()
    assert told == ["/slamhive/loam.launch", "rviz:=false", "scanPeriod:=0.1", "lidar:=VLP-16"]
    assert (result / "played").read_text() == "play /slamhive/dataset/track.bag /points:=/points_raw --clock\n"
    run = hive.runs.get(failed)
    assert run.reason is FailureReason.PLAYER_FAILED
    assert run.detail == "the recording was not played: rosbag play ended with exit code 1: Error opening file"
    assert {entry: entry.read_bytes() for entry in path.rglob("*") if entry.is_file()} == before
    assert hive.algorithms.remove("by-image", "docker") is None
    assert hive.algorithms.remove("loam-of-tests", "docker") is None
    assert hive.catalogue.broken() == ()


@pytest.fixture
def empty_image(tmp_path: Path) -> Iterator[str]:
    """An image with one file and no program, as :func:`docker save` names it."""
    name = "slam-hive-test:empty"
    with tarfile.open(tmp_path / "files.tar", "w") as tar:
        tar.addfile(tarfile.TarInfo("file"))
    run_docker("import", str(tmp_path / "files.tar"), name)
    yield name
    run_docker("rmi", "--force", name)


@pytest.mark.docker
def test_an_archive_is_loaded_without_its_names(engine_hive: Hive, empty_image: str, tmp_path):
    saved = tmp_path / "saved.tar"
    run_docker("save", "--output", str(saved), empty_image)
    run_docker("rmi", empty_image)
    tools = engine_hive.executors.get("docker").image_tools()
    digest = tools.load(ImageArchive(saved).chunks(lambda _line: None))
    assert tools.find(digest) == digest
    assert tools.find(empty_image) is None
    request = PackageImportRequest("from-tar", None, str(saved), executor="docker")
    with pytest.raises(ImageMissing, match=r"^the image has no python3, and it cannot be installed: ") as refused:
        with_plan(engine_hive, str(folders.loam(tmp_path)), request)
    assert "/bin/sh" in str(refused.value)  # the image has none
    assert len(str(refused.value)) < 600
    assert list(engine_hive.settings.algorithms_folder.iterdir()) == []
    run_docker("rmi", "--force", digest)


@pytest.mark.docker
@pytest.mark.images
def test_python_is_put_on_top_of_an_image_without_it(engine_hive: Hive, tmp_path):
    """Debian's smallest system has none."""
    path = folders.loam(tmp_path).rename(tmp_path / "loam-without-python")
    folders.write(path, Dockerfile=f"FROM {project_base()}\nCOPY slamhive /slamhive\n")
    lines: list[str] = []
    with engine_hive.algorithms.planned(str(path), DOCKER) as planned:
        made = engine_hive.algorithms.perform(planned, lines.append)
    assert "the image has no python3: installing it" in lines
    assert any("put on top of the image" in note and "python3" in note and "PyYAML" in note for note in made.notes)
    script = "import sys, yaml; print(yaml.safe_load('a: 1')['a'])"
    image = made.algorithms[0].package.image
    ended = run_docker("run", "--rm", "--network", "none", "--entrypoint", "python3", image, "-c", script)
    assert ended.stdout == "1\n", ended.stderr


def test_the_image_of_another_package_is_not_taken(tmp_path):
    folder = folders.loam(tmp_path).rename(tmp_path / "kiss-icp")
    engine = create_autospec(ImageTools, instance=True)
    engine.find.return_value = "sha256:1"
    with opened(str(folder)) as source:
        assert plan(source, PackageImportRequest("mine"), engine).image == "slam-hive-algorithm:kiss-icp"
        with pytest.raises(InvalidInput, match="slam-hive-algorithm:kiss-icp belongs to another package; give the im"):
            plan(source, PackageImportRequest("mine"), engine, {"slam-hive-algorithm:kiss-icp"})


def test_a_folder_whose_submodules_were_not_fetched_names_the_line(tmp_path):
    folder = folders.orb_slam2(tmp_path)
    (folder / "ORB_SLAM2").mkdir()
    engine = create_autospec(ImageTools, instance=True)
    engine.find.return_value = None
    with opened(str(folder)) as source, pytest.raises(InvalidInput) as refused:
        plan(source, PackageImportRequest("mine"), engine)
    assert "line 3 copies ORB_SLAM2, which is an empty link of Git" in refused.value.message
    assert "fetch it with `git submodule update --init --recursive`, or give the image" in str(refused.value)


@pytest.mark.docker
def test_what_has_no_image_or_no_scripts_says_what_to_give(engine_hive: Hive, base_image: str, tmp_path):
    folder = folders.loam(tmp_path).rename(tmp_path / "no-image-has-this-name")
    with pytest.raises(InvalidInput, match=r"has no Dockerfile; give the image: --image NAME, or --image FILE\.tar"):
        with_plan(engine_hive, str(folder), DOCKER)
    folder = folders.orb_slam2(tmp_path).rename(tmp_path / "nor-has-this-name")
    with pytest.raises(InvalidInput, match=r"line 3 copies ORB_SLAM2, which the folder does not hold; give the image"):
        with_plan(engine_hive, str(folder), DOCKER)
    with pytest.raises(InvalidInput, match=r"holds no /slamhive/mapping\.py.*with --image"):
        with_plan(engine_hive, base_image, PackageImportRequest("by-name", executor="docker"))
    assert not list(engine_hive.settings.algorithms_folder.glob("*"))


@pytest.mark.docker
def test_a_preview_on_the_command_line_changes_nothing(engine_hive: Hive, base_image: str, tmp_path):
    source, options = str(folders.orb_slam2(tmp_path)), ["--image", base_image, "--executor", "docker", "--preview"]
    shown = CliRunner().invoke(main, ["algorithm", "import", source, *options])
    assert shown.exit_code == 0, shown.output
    assert f"takes {base_image} (as you asked)" in shown.output
    assert 'licence: "unknown"  # not known: please fill in' in shown.output
    assert "runs are root without capabilities: slamhive/mapping.py names /home/ORB_SLAM2" in shown.stderr
    content = json.loads(CliRunner().invoke(main, ["algorithm", "import", source, *options, "--json"]).stdout)
    assert content["unknown"] == ["upstream", "licence", "citation", "default of gain"]
    assert not list(engine_hive.settings.algorithms_folder.glob("*"))


@pytest.mark.docker
def test_a_build_that_needs_the_net_names_the_step(engine_hive: Hive, base_image: str, tmp_path):
    path = folders.loam(tmp_path)
    fetch = "import socket; socket.create_connection((chr(120) + chr(46) + chr(105), 80))"
    folders.write(path, Dockerfile=f"FROM {base_image}\nRUN python3 -c '{fetch}'\n")
    with pytest.raises(ImageMissing, match=r"building loam failed at Step 2/2 : RUN python3 .*(resolution|not known)"):
        with_plan(engine_hive, str(path), DOCKER)
    assert not list(engine_hive.settings.algorithms_folder.glob("*"))
