"""Runs whose image wants a user of its own, as published images do."""

from __future__ import annotations

import os
import stat
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from slamhive.domain.algorithm import RunUser
from slamhive.executors.base import ExecutorContext, StartFailed
from slamhive.executors.docker.containers import container_options, open_to_user
from slamhive.executors.docker.executor import DockerExecutor
from slamhive.executors.spec import ResourceLimits, RunInput, RunOutput, RunSpec
from tests.executors.conftest import Bench, wait_for_end
from tests.services.docker_base import run_docker

NOBODY = 65534
SCRIPT = """
import os, pathlib, stat, subprocess
os.makedirs(os.path.expanduser("~/.ros"))
os.makedirs("/home/output")
result = pathlib.Path("/slamhive/result")
(result / "home").write_text("{} {} {}".format(os.environ["HOME"], "ROS_HOME" in os.environ, os.getuid()))
capabilities = [line for line in open("/proc/self/status") if line.startswith("Cap")]
(result / "capabilities").write_text("".join(capabilities))
(result / "closed" / "deep").mkdir(parents=True)
(result / "closed" / "deep" / "file").write_text("x")
program = result / "program"
program.write_text("x")
program.chmod(0o4755)
(result / "link").symlink_to("/etc/passwd")
(result / "closed").chmod(0o700)
"""


@contextmanager
def as_nobody() -> Iterator[None]:
    """A worker that is not root. The process of the tests may be one already."""
    if os.getuid() != 0:
        yield
        return
    groups = os.getgroups()
    os.setgroups([Path("/var/run/docker.sock").stat().st_gid])
    os.setresgid(NOBODY, NOBODY, 0)
    os.setresuid(NOBODY, NOBODY, 0)
    try:
        yield
    finally:
        os.setresuid(0, 0, 0)
        os.setresgid(0, 0, 0)
        os.setgroups(groups)


def made_spec(folder: Path, user: RunUser) -> RunSpec:
    config = folder / "config.yaml"
    config.touch()
    inputs = (RunInput("config", config, "/slamhive/config.yaml"),)
    outputs = (RunOutput("result", folder, "/slamhive/result"),)
    command = ("python3", "/slamhive/mapping.py")
    limits, work = ResourceLimits(), folder / "work"
    return RunSpec("key", 7, "demo", folder, "image:tag", "x", command, inputs, outputs, {}, limits, 9.0, work, user)


@pytest.mark.parametrize(
    ("user", "expected"),
    [(RunUser.WORKER, f"{os.getuid()}:{os.getgid()}"), (RunUser.ROOT, "0:0"), (RunUser.IMAGE, None)],
)
def test_only_the_worker_has_another_home_than_the_image_gives(tmp_path, user, expected):
    options = container_options(made_spec(tmp_path, user), ExecutorContext(tmp_path, tmp_path, "installation-1"))
    assert options["user"] == expected
    assert ("HOME" in options["environment"]) is (user is RunUser.WORKER)
    assert "ROS_HOME" not in options["environment"]
    assert options["cap_drop"] == ["ALL"]


@pytest.fixture
def open_folder() -> Iterator[Path]:
    """A folder that any user can reach; those of pytest are closed, also by sessions that start meanwhile."""
    with tempfile.TemporaryDirectory(prefix="slamhive-test-user-") as name:
        Path(name).chmod(0o755)
        yield Path(name)


def owned_by_nobody(*folders: Path) -> None:
    if os.getuid() == 0:
        for folder in folders:
            for path in (folder, *folder.rglob("*")):
                os.chown(path, NOBODY, NOBODY)


@pytest.mark.docker
@pytest.mark.parametrize("maker", ["docker"], indirect=True)
def test_root_writes_where_its_image_expects_and_leaves_what_the_worker_can_delete(bench: Bench, open_folder):
    bench.root = open_folder
    spec = replace(bench.spec(SCRIPT), user=RunUser.ROOT)
    owned_by_nobody(open_folder)
    with as_nobody():
        executor = DockerExecutor(bench.context)
        handle = executor.start(spec)
        try:
            assert not stat.S_IMODE(spec.work.parent.stat().st_mode) & 0o007
            ended = wait_for_end(executor, handle)
            executor.save_log(handle, bench.log(spec))
            assert ended.exit_code == 0, bench.log(spec).read_text()
            executor.collect(spec, handle)
        finally:
            executor.remove(handle)
            executor.close()
        result = bench.result(spec)
        assert (result / "home").read_text() == "/root False 0"
        assert set((result / "capabilities").read_text().split()[1::2]) == {"0" * 16}
        assert {path.lstat().st_uid for path in spec.work.parent.rglob("*")} == {os.getuid()}
        assert not (result / "program").stat().st_mode & stat.S_ISUID
        (result / "closed" / "deep" / "file").unlink()
        assert "root without capabilities" in (handle.protections.held_by if handle.protections else "")


@pytest.mark.docker
@pytest.mark.parametrize("maker", ["docker"], indirect=True)
def test_the_user_of_the_image_writes_to_its_home(bench: Bench, base_image):
    name = f"slam-hive-test:{uuid.uuid4().hex}"
    container = run_docker("create", base_image, "true").stdout.strip()
    try:
        made = run_docker("commit", "--change=ENV HOME=/home/ubuntu", "--change=USER 1234", container, name)
        assert made.returncode == 0, made.stderr
        script = "import os\nopen('/slamhive/result/who', 'w').write(str(os.getuid()) + os.environ['HOME'])\n"
        spec = replace(bench.spec(script), user=RunUser.IMAGE, identity=made.stdout.strip())
        handle = bench.executor.start(spec)
        bench.handles.append(handle)
        assert bench.end(spec, handle).exit_code == 0
        who = bench.result(spec) / "who"
        assert (who.read_text(), who.stat().st_uid) == ("1234/home/ubuntu", os.getuid())
    finally:
        run_docker("rm", "--force", container)
        run_docker("rmi", "--force", name)


def test_an_input_that_the_user_may_not_read_is_named(tmp_path):
    spec = made_spec(tmp_path, RunUser.IMAGE)
    spec.inputs[0].source.chmod(0o600)
    with pytest.raises(StartFailed, match=r"run 7 is the user of the image.* may not read .*config\.yaml"):
        open_to_user(spec, rootless=False)
