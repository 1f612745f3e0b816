from __future__ import annotations

import os
import shutil
import stat
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from slamhive.domain.algorithm import AlgorithmPackage
from slamhive.executors.base import EngineUnavailable, Executor, ExecutorContext, NodeAccess, PackageNeed
from slamhive.executors.kubernetes import run_jobs
from slamhive.executors.kubernetes.executor import KubernetesExecutor
from slamhive.executors.node_store.server import NodeServer
from slamhive.executors.process.containment import KINDS, choose_containment
from slamhive.executors.process.containment_base import ContainmentRequest, DoesNotHold
from slamhive.executors.process.executor import ProcessExecutor
from slamhive.executors.registry import ExecutorFactory, open_executor
from slamhive.executors.spec import ResourceLimits, RunInput, RunOutput, RunSpec
from slamhive.executors.status import Exited, RunHandle, Running
from slamhive.run_folder.folder import RunFolder
from tests.executors.api_server import ApiServer
from tests.executors.kubernetes_cluster import KubernetesCluster, why_no_kubernetes
from tests.executors.node_stores import serving
from tests.executors.played_nodes import MakeKubernetes, Nodes
from tests.executors.plugins import PLUGINS, Agent, distributions_in, install_plugins
from tests.executors.slurm_cluster import Cluster, cannot_start_because
from tests.sharing import made_once, share_environments
from tests.waiting import PATIENCE_S, eventually

if TYPE_CHECKING:
    import docker

    from tests.executors.docker_nodes import DockerNodes

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
    containment: str = ""
    handles: list[RunHandle] = field(default_factory=list)

    def spec(self, script: str, limits: ResourceLimits | None = None, key: str | None = None) -> RunSpec:
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
                RunInput("script", scripts / "mapping.py", "/slamhive/mapping.py"),
                RunInput("config", folder.config, "/slamhive/config.yaml"),
                RunInput("recording", bag, "/slamhive/dataset/bag.bag"),
            ),
            outputs=(RunOutput("result", folder.result, "/slamhive/result", live=LIVE),),
            environment={},
            limits=limits or self.limits,
            timeout_s=60.0,
            work=folder.work,
        )

    def start(self, script: str, limits: ResourceLimits | None = None) -> tuple[RunSpec, RunHandle]:
        spec = self.spec(script, limits)
        handle = self.start_spec(spec)
        self.handles.append(handle)
        return spec, handle

    def start_spec(self, spec: RunSpec) -> RunHandle:
        """Start it as a worker does: again, while its node fetches what it needs."""
        deadline_s = time.monotonic() + PATIENCE_S
        while True:
            try:
                return self.executor.start(spec)
            except EngineUnavailable:
                if self.executor.capabilities.shares_files or time.monotonic() > deadline_s:
                    raise

    def sees(self, spec: RunSpec, handle: RunHandle, name: str) -> bool:
        """Whether the controller sees a live file of the result."""
        self.executor.refresh(spec, handle)
        return (self.result(spec) / name).exists()

    def wait_for(self, spec: RunSpec, handle: RunHandle, name: str = "ready") -> None:
        eventually(lambda: self.sees(spec, handle, name), name)

    def end(self, spec: RunSpec, handle: RunHandle) -> Exited:
        """How the run ended, with its outputs on the controller."""
        status = wait_for_end(self.executor, handle)
        self.executor.collect(spec, handle)
        return status

    @property
    def limits(self) -> ResourceLimits:
        """Limits that every run of these tests has where they are promised."""
        return ResourceLimits().only(self.executor.capabilities.limits)

    def result(self, spec: RunSpec) -> Path:
        return spec.output("result").destination

    def log(self, spec: RunSpec) -> Path:
        return RunFolder(spec.work.parent).log

    def again(self) -> Executor:
        """A new executor, as a restarted worker has."""
        return self.make()


@dataclass(frozen=True)
class Maker:
    """How an executor is made, as often as a worker restarts."""

    name: str
    context: ExecutorContext
    make: Callable[[], Executor]
    containment: str = ""


@pytest.fixture
def engine() -> Iterator[docker.DockerClient]:
    """A client of the Docker engine."""
    import docker  # noqa: PLC0415 - the SDK takes long to load

    with closing(docker.from_env()) as client:
        yield client


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
    data = tmp_path_factory.mktemp("data")
    share_environments(data)
    return data


@pytest.fixture(scope="session")
def plugin_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the executors of other packages are installed."""
    sources = tmp_path_factory.mktemp("plugins")
    return made_once("executor-plugins", lambda folder: install_plugins(sources, folder))


@pytest.fixture(scope="session")
def plugins(plugin_folder: Path) -> Iterator[dict[str, ExecutorFactory]]:
    """The executors of other packages, as their entry points announce them."""
    sys.path.append(str(plugin_folder))
    found = {point.name: point.load() for point in distributions_in(plugin_folder)}
    yield found
    sys.path.remove(str(plugin_folder))


@pytest.fixture
def agent(tmp_path: Path, plugin_folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Agent]:
    """An agent with files of its own."""
    root = tmp_path / "another-machine"
    root.mkdir()
    share_environments(root)  # with other agents: the controller needs none of its own
    with Agent(root, plugin_folder) as agent:
        for name, value in agent.variables.items():
            monkeypatch.setenv(name, value)
        yield agent


@pytest.fixture(scope="session")
def slurm_daemons(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """A Slurm of these tests with two nodes, both this machine."""
    reason = cannot_start_because()
    if reason is not None:
        pytest.skip(reason)  # under CI=true a failure, see tools/test.py
    with Cluster(tmp_path_factory.mktemp("slurm")) as cluster:
        yield cluster


@pytest.fixture(scope="session")
def apart_daemons(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """A Slurm whose nodes see no file of the tests, and have a cache each."""
    reason = cannot_start_because()
    if reason is not None:
        pytest.skip(reason)  # as above
    with Cluster(tmp_path_factory.mktemp("slurm"), tmp_path_factory.getbasetemp()) as cluster:
        yield cluster


@pytest.fixture
def apart_cluster(apart_daemons: Cluster, monkeypatch: pytest.MonkeyPatch) -> Cluster:
    """The Slurm of nodes apart, which the commands of this process find."""
    for name, value in apart_daemons.variables.items():
        monkeypatch.setenv(name, value)
    return apart_daemons


@pytest.fixture
def node_server(environment_data: Path) -> Iterator[NodeServer]:
    """What a worker serves to nodes that see no file of the tests."""
    with serving(environment_data) as server:
        yield server


@pytest.fixture
def slurm_cluster(slurm_daemons: Cluster, monkeypatch: pytest.MonkeyPatch) -> Cluster:
    """The Slurm of these tests, which the commands of this process find."""
    for name, value in slurm_daemons.variables.items():
        monkeypatch.setenv(name, value)
    return slurm_daemons


LIVE = ("ready", "starts", "alive", "used")
"""What the scripts of these tests write while they run."""

HOLDING = tuple(kind for kind in KINDS if _holds(kind))
"""The containments that can be had on this machine by who runs the tests."""
_DOCKER = pytest.param("docker", marks=pytest.mark.docker)
_LONG = (pytest.mark.cluster, pytest.mark.long)
_KUBERNETES = pytest.param("kubernetes", marks=pytest.mark.cluster)
_KUBERNETES_APART = pytest.param("kubernetes-apart", marks=_LONG)
_PODS_OF_DOCKER = [pytest.param(f"kubernetes-{name}", marks=pytest.mark.cluster) for name in ("docker", "docker-apart")]
EVERYWHERE = [*(f"process-{kind}" for kind in HOLDING), _DOCKER]
"""The parameters of ``bench`` for all of them, and for containers."""
REFUSING = [*(f"process-{kind}" for kind in HOLDING if kind != "tree"), _DOCKER]
"""Those where the kernel refuses a process; the supervisor can only end the run."""


_SLURM = pytest.param("slurm", marks=pytest.mark.cluster)
_SLURM_ENVIRONMENT = pytest.param("slurm-none", marks=pytest.mark.cluster)
_SLURM_APART = pytest.param("slurm-apart", marks=_LONG)
APPTAINER = [pytest.param(f"slurm-{name}", marks=_LONG) for name in ("apptainer", "apart-apptainer")]
"""Slurm with Apptainer, which Debian 12 does not have: skipped where it is not installed."""
ALL = [
    *("process", _DOCKER, _SLURM, _SLURM_ENVIRONMENT, *APPTAINER, _SLURM_APART),
    *(_KUBERNETES, _KUBERNETES_APART, *_PODS_OF_DOCKER),
    *("remote", "plain"),
]
"""The parameters of ``bench`` for every executor: those that ship, one on another machine, one of the documentation.

Slurm has five: with containers of Charliecloud, without containers, on nodes that see no file of the tests, and both
kinds of nodes with containers of Apptainer. Kubernetes has four: nodes that share files, and nodes that see none, each
with its own programs, and with an API server of these tests whose pods are containers of Docker.
"""


@pytest.fixture(scope="session")
def kubernetes_cluster(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[KubernetesCluster]:
    """A real control plane with two nodes, which have the image of these tests."""
    reason = why_no_kubernetes()
    if reason is not None:
        pytest.skip(reason)  # before the image is made
    base_image = request.getfixturevalue("base_image")
    with KubernetesCluster(tmp_path_factory.mktemp("kubernetes")) as cluster:
        cluster.load(base_image)
        yield cluster


@pytest.fixture
def nodes() -> Nodes:
    """Nodes on which pods begin at once, unless a test wants something else."""
    return Nodes()


@pytest.fixture
def server(nodes: Nodes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ApiServer]:
    """An API server with these nodes, which the kubeconfig of this process names."""
    with ApiServer(nodes) as made:
        nodes.server = made
        monkeypatch.setenv("KUBECONFIG", str(made.kubeconfig(tmp_path / "kubeconfig")))
        yield made


@pytest.fixture
def docker_nodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[DockerNodes]:
    """Nodes whose pods are containers of Docker, and their API server, which the kubeconfig of this process names."""
    from tests.executors.docker_nodes import DockerNodes  # noqa: PLC0415 - the SDK takes long to load

    nodes = DockerNodes(tmp_path)
    with ApiServer(nodes) as made:
        nodes.server = made
        monkeypatch.setenv("KUBECONFIG", str(made.kubeconfig(tmp_path / "kubeconfig")))
        yield nodes
        nodes.close()


@pytest.fixture
def make_kubernetes(server: ApiServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[MakeKubernetes]:
    """Makes executors that ask this API server, as workers that follow each other have them."""
    monkeypatch.setattr(run_jobs, "START_WAIT_S", 0.15)
    monkeypatch.setattr(run_jobs, "_LOOK_EVERY_S", 0.02)
    monkeypatch.setattr(run_jobs, "_SHORTEST_PAUSE_S", 0.02)
    made: list[KubernetesExecutor] = []

    def make(options: str = "", installation: str = "home", nodes: NodeAccess | None = None) -> KubernetesExecutor:
        context = ExecutorContext(tmp_path, PROJECT_ROOT, installation, nodes=nodes, options={"options": options})
        made.append(KubernetesExecutor(context))
        return made[-1]

    yield make
    for executor in made:
        executor.close()


@pytest.fixture
def node_access(
    kubernetes_cluster: KubernetesCluster, environment_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[NodeAccess]:
    """The way to nodes that see nothing of a test; they are served meanwhile."""
    kubernetes_cluster.use(monkeypatch)
    kubernetes_cluster.separate_caches()
    kubernetes_cluster.hide(environment_data, tmp_path)
    server = NodeServer(environment_data, "127.0.0.1", kubernetes_cluster.port)
    server.start()
    yield NodeAccess(kubernetes_cluster.url, str(kubernetes_cluster.cache), 10**9)
    server.close()


@pytest.fixture
def maker(request, tmp_path: Path, environment_data: Path) -> Maker:
    """Makes the executor that a test asks for, from its name or as ``process-<containment>``."""
    name, _, containment = request.param.partition("-")
    if containment == "user":
        open_to_other_users(tmp_path, environment_data)
    context = ExecutorContext(environment_data, PROJECT_ROOT, uuid.uuid4().hex, 100_000)
    runtime = "apptainer" if containment.endswith("apptainer") else "auto"
    if runtime == "apptainer" and shutil.which(runtime) is None:
        pytest.skip("there is no Apptainer on this machine")
    if containment.startswith("apart") and name == "slurm":
        cluster, server = request.getfixturevalue("apart_cluster"), request.getfixturevalue("node_server")
        access = NodeAccess(server.url, str(cluster.cache), 2 * 10**9)
        apart = replace(context, nodes=access, options={"containers": runtime})
        return Maker(name, apart, lambda: open_executor(name, apart))
    if name == "kubernetes":
        return kubernetes_maker(request, context, tmp_path)
    if name == "slurm":
        request.getfixturevalue("slurm_cluster")
        slurm = replace(context, options={"containers": containment or "auto"})
        return Maker(name, slurm, lambda: open_executor(name, slurm))
    if containment:
        return Maker(name, context, lambda: ProcessExecutor(context, containment), containment)
    if name in PLUGINS:
        plugin = request.getfixturevalue("plugins")[name]
        if name == "remote":
            request.getfixturevalue("agent")
        return Maker(name, context, lambda: plugin(context))
    return Maker(name, context, lambda: open_executor(name, context))


def kubernetes_maker(request: pytest.FixtureRequest, context: ExecutorContext, tmp_path: Path) -> Maker:
    """Makes the executor of Kubernetes for one of its four kinds of nodes."""
    opened: list[Executor] = []
    if request.param.startswith("kubernetes-docker"):
        opened = request.getfixturevalue("docker_nodes").executors
        if request.param.endswith("apart"):
            access = NodeAccess(request.getfixturevalue("node_server").url, str(tmp_path / "node-cache"), 10**9)
            context = replace(context, nodes=access)
    elif request.param == "kubernetes-apart":
        context = replace(context, nodes=request.getfixturevalue("node_access"))
    else:
        request.getfixturevalue("kubernetes_cluster").use(request.getfixturevalue("monkeypatch"))

    def make() -> Executor:
        opened.append(open_executor("kubernetes", context))
        return opened[-1]

    return Maker(request.param, context, make)


@pytest.fixture
def bench(request, maker: Maker, tmp_path: Path, test_package: AlgorithmPackage) -> Iterator[Bench]:
    """An executor by its name, or the process executor with one containment (``process-tree``)."""
    executor = maker.make()
    if executor.capabilities.needs is PackageNeed.IMAGE:
        from slamhive.executors.docker.executor import DockerExecutor  # noqa: PLC0415 - the SDK takes long to load
        from tests.services.docker_base import run_docker  # noqa: PLC0415

        image = request.getfixturevalue("base_image")
        identity = run_docker("image", "inspect", "--format", "{{.Id}}", image).stdout.strip()
        if not executor.has(test_package, identity):
            with closing(DockerExecutor(maker.context)) as docker:
                assert executor.load_image(docker.save_image(identity)) == identity
    else:
        image, identity = test_package.image, executor.build(test_package, lambda line: None)
    bench = Bench(maker.name, maker.context, tmp_path, replace(test_package), image, identity, executor, maker.make)
    bench.containment = maker.containment
    yield bench
    for handle in bench.handles:
        executor.remove(handle)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Tests that name no executor run on the two that ship; those of the contract on all."""
    if "maker" in metafunc.fixturenames and not _chosen(metafunc):
        contract = metafunc.module.__name__.endswith("test_contract")
        metafunc.parametrize("maker", ALL if contract else ["process", _DOCKER], indirect=True)


def _chosen(metafunc: pytest.Metafunc) -> bool:
    marks = metafunc.definition.iter_markers("parametrize")
    return any("maker" in str(mark.args[0]).split(",") for mark in marks)
