from __future__ import annotations

import os
import stat
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest

from slamhive.domain.algorithm import AlgorithmPackage
from slamhive.executors.base import Executor, ExecutorContext
from slamhive.executors.process.containment import KINDS, choose_containment
from slamhive.executors.process.containment_base import ContainmentRequest, DoesNotHold
from slamhive.executors.process.executor import ProcessExecutor
from slamhive.executors.registry import open_executor
from slamhive.executors.spec import Input, Limits, Output, RunSpec
from slamhive.executors.status import Exited, RunHandle, Running
from slamhive.runs.folder import RunFolder
from tests.waiting import eventually

PROJECT_ROOT = Path(__file__).resolve().parents[2]


def _holds(kind: str) -> bool:
    request = ContainmentRequest("tests", f"collection-{os.getpid()}", 16)
    try:
        choose_containment(request, kind).containment.remove()
    except DoesNotHold:
        return False
    return True


def open_to_other_users(*folders: Path) -> None:
    """What pytest makes is closed to others; a user of its own could not read it."""
    for folder in folders:
        for parent in (folder, *folder.parents):
            if parent.stat().st_uid == os.getuid():
                parent.chmod(parent.stat().st_mode | stat.S_IXGRP | stat.S_IXOTH)


def wait_for_end(executor: Executor, handle: RunHandle) -> Exited:
    """How the run ended, once it has; it may be lost in no other way."""
    eventually(lambda: not isinstance(executor.poll(handle), Running), "the end of the run")
    status = executor.poll(handle)
    assert isinstance(status, Exited), status
    return status


@dataclass
class Bench:
    """Starts scripts through one executor, and tidies up."""

    name: str
    context: ExecutorContext
    root: Path
    package: AlgorithmPackage
    image: str
    identity: str
    executor: Executor
    make: Callable[[], Executor]
    handles: list[RunHandle] = field(default_factory=list)

    def spec(self, script: str, limits: Limits | None = None, key: str | None = None) -> RunSpec:
        key = key or f"test-{uuid.uuid4().hex[:12]}"
        folder = RunFolder(self.root / key)
        folder.create()
        folder.config.write_text("slam-hive-algorithm: test\n")
        scripts = folder.root / "scripts"
        scripts.mkdir(exist_ok=True)
        (scripts / "mapping.py").write_text(script)
        bag = self.root / "bag.bag"
        bag.write_bytes(b"bag")
        return RunSpec(
            key=key,
            run_id=1,
            package=self.package.name,
            package_folder=self.package.folder,
            image=self.image,
            identity=self.identity,
            command=("python3", "/slamhive/mapping.py"),
            inputs=(
                Input("script", scripts / "mapping.py", "/slamhive/mapping.py"),
                Input("config", folder.config, "/slamhive/config.yaml"),
                Input("recording", bag, "/slamhive/dataset/bag.bag"),
            ),
            outputs=(Output("result", folder.result, "/slamhive/result", live=("ready",)),),
            environment={},
            limits=limits or Limits(),
            timeout_s=60.0,
            work=folder.work,
        )

    def start(self, script: str, limits: Limits | None = None) -> tuple[RunSpec, RunHandle]:
        spec = self.spec(script, limits)
        handle = self.executor.start(spec)
        self.handles.append(handle)
        return spec, handle

    def result(self, spec: RunSpec) -> Path:
        return spec.output("result").destination

    def log(self, spec: RunSpec) -> Path:
        return RunFolder(spec.work.parent).log

    def again(self) -> Executor:
        """A new executor, as a restarted worker has."""
        return self.make()


@pytest.fixture(scope="session")
def test_package(tmp_path_factory: pytest.TempPathFactory) -> AlgorithmPackage:
    folder = tmp_path_factory.mktemp("packages") / "sleeper"
    (folder / "slamhive").mkdir(parents=True)
    (folder / "slamhive" / "mapping.py").write_text("print('from the package')\n")
    (folder / "requirements.txt").write_text("")
    (folder / "prepare.py").write_text(
        "import os, pathlib\npathlib.Path(os.environ['SLAMHIVE_PREPARE_DIR'], 'made').write_text('yes')\n"
    )
    return AlgorithmPackage("sleeper", folder, "Sleeper", "1", "", "", "")


@pytest.fixture(scope="session")
def environment_data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("data")


HOLDING = tuple(kind for kind in KINDS if _holds(kind))
"""The containments that can be had on this machine by who runs the tests."""
_DOCKER = pytest.param("docker", marks=pytest.mark.docker)
EVERYWHERE = [*(f"process-{kind}" for kind in HOLDING), _DOCKER]
"""The parameters of ``bench`` for all of them, and for containers."""
REFUSING = [*(f"process-{kind}" for kind in HOLDING if kind != "tree"), _DOCKER]
"""Those where the kernel refuses a process; the supervisor can only end the run."""


@pytest.fixture(params=["process", _DOCKER])
def bench(request, tmp_path: Path, test_package: AlgorithmPackage, environment_data: Path) -> Iterator[Bench]:
    """An executor by its name, or the process executor with one containment (``process-tree``)."""
    name, _, containment = request.param.partition("-")
    if containment == "user":
        open_to_other_users(tmp_path, environment_data)
    installation = uuid.uuid4().hex
    context = ExecutorContext(environment_data, PROJECT_ROOT, installation, 100_000)

    def make() -> Executor:
        return ProcessExecutor(context, containment) if containment else open_executor(name, context)

    executor = make()
    image = request.getfixturevalue("base_image") if name == "docker" else test_package.image
    if name == "docker":
        from tests.services.docker_base import run_docker  # noqa: PLC0415 - the SDK takes long to load

        identity = run_docker("image", "inspect", "--format", "{{.Id}}", image).stdout.strip()
    else:
        identity = executor.build(test_package, lambda line: None)
    bench = Bench(name, context, tmp_path, replace(test_package), image, identity, executor, make)
    yield bench
    for handle in bench.handles:
        executor.remove(handle)
