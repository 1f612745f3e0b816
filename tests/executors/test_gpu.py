"""GPUs through nvidia-ml-py and a shared object that speaks NVML's C interface, as the driver's library does."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import uuid
from dataclasses import replace
from pathlib import Path

import psutil
import pytest

from slamhive.base.errors import InvalidInput, Unavailable
from slamhive.domain.algorithm import AlgorithmPackage, GivenGpu, Gpu, GpuNeed
from slamhive.executors.base import ExecutorContext
from slamhive.executors.docker.containers import container_options
from slamhive.executors.docker.engine import GPU_LABEL, KEY_LABEL, connect
from slamhive.executors.docker.executor import DockerExecutor
from slamhive.executors.gpu import HEADER, MACHINE_NAMESPACE, GpuLog, GpuUse, below, in_container, lease_gpu
from slamhive.executors.host import describe_host
from slamhive.executors.process.executor import ProcessExecutor, launch
from slamhive.executors.process.shim_spec import ShimSpec
from slamhive.executors.slurm import gpus
from slamhive.executors.slurm.executor import SlurmExecutor
from slamhive.executors.slurm.gpus import GpuReadings, use_of
from slamhive.executors.slurm.node import PLACE_FILE, USAGE_FILE, JobPlace
from slamhive.executors.spec import ResourceLimits, RunOutput, RunSpec
from slamhive.executors.status import RunHandle
from slamhive.run_folder.folder import RunFolder
from slamhive.run_folder.profiling import _gpu_metrics
from slamhive.services.runs import check_gpu
from tests.waiting import eventually

SOURCE = Path(__file__).parent / "nvml" / "fake_nvml.c"
FIRST, SECOND = (Gpu(f"GPU-{name}", "model", "driver", 8) for name in ("first", "second"))

ASK = """
import dataclasses, json, sys
from slamhive.executors.gpu import gpu_use, list_gpus
from slamhive.base.errors import Unavailable
gpus = [dataclasses.asdict(gpu) for gpu in list_gpus()]
use = dataclasses.asdict(gpu_use(gpus[1]["uuid"], lambda pid: pid in (11, 12)))
other = dataclasses.asdict(gpu_use(gpus[1]["uuid"], lambda pid: pid == 14))
unknown = dataclasses.asdict(gpu_use(gpus[1]["uuid"], lambda pid: None))
nobody = dataclasses.asdict(gpu_use(gpus[1]["uuid"], lambda pid: False))
try:
    gpu_use("GPU-gone", lambda pid: True)
except Unavailable as error:
    gone = str(error)
print(json.dumps([gpus, use, other, unknown, nobody, gone]))
"""


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """The folder with the shared object."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("there is no C compiler")
    folder = tmp_path_factory.mktemp("nvml")
    target = str(folder / "libnvidia-ml.so.1")
    subprocess.run([compiler, "-shared", "-fPIC", "-O0", "-o", target, str(SOURCE)], check=True)
    return folder


def ask(library: Path, answers: Path):
    environment = {**os.environ, "LD_LIBRARY_PATH": str(library), "FAKE_NVML": str(answers)}
    done = subprocess.run([sys.executable, "-c", ASK], env=environment, capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


@pytest.mark.integration
def test_gpus_and_the_memory_of_a_run_are_read_through_nvml(library, tmp_path):
    answers = tmp_path / "answers"
    answers.write_text("11 1000\n12 500\n13 9000\n14\nbusy 75\n")
    gpus, use, other, unknown, nobody, gone = ask(library, answers)
    assert gpus[1] == {
        "uuid": "GPU-11111111-aaaa-bbbb-cccc-111111111111",
        "model": "NVIDIA RTX A6000",
        "driver": "570.86.10",
        "memory_bytes": 51527024640,
    }
    assert [gpu["model"] for gpu in gpus] == ["NVIDIA GeForce RTX 4090", "NVIDIA RTX A6000"]
    assert use == {"memory_bytes": 1500, "utilisation": 0.75}
    # Under virtualisation the driver does not say how much memory a process has: that is not zero.
    assert other == {"memory_bytes": None, "utilisation": 0.75}
    assert unknown == {"memory_bytes": None, "utilisation": 0.75}
    assert nobody == {"memory_bytes": 0, "utilisation": 0.75}
    assert "GPU GPU-gone cannot be measured: Not Found" in gone


def test_a_process_is_recognised_by_the_control_group_of_its_container(tmp_path):
    for pid, group in ((7, "0::/system.slice/docker-abc123.scope"), (8, "0::/user.slice"), (9, "3:cpu:/docker/abc123")):
        (tmp_path / str(pid)).mkdir()
        (tmp_path / str(pid) / "cgroup").write_text(f"{group}\n")
    namespace = tmp_path / "self" / "ns" / "pid"
    namespace.parent.mkdir(parents=True)
    namespace.symlink_to(MACHINE_NAMESPACE)
    belongs = in_container("abc123", tmp_path)
    assert [belongs(pid) for pid in (7, 8, 9, 10)] == [True, False, True, False]
    namespace.unlink()
    namespace.symlink_to("pid:[4026532999]")
    belongs = in_container("abc123", tmp_path)
    assert [belongs(pid) for pid in (7, 10)] == [None, None], "in a container, 7 is another process"


@pytest.mark.docker
def test_the_processes_of_a_real_container_are_recognised(base_image):
    if str(Path("/proc/self/ns/pid").readlink()) != MACHINE_NAMESPACE:
        pytest.skip("the tests run in a container")
    client = connect()
    container = client.containers.run(base_image, ["sleep", "60"], network_mode="none", detach=True)
    try:
        container.reload()
        belongs = in_container(str(container.id))
        assert [belongs(int(container.attrs["State"]["Pid"])), belongs(os.getpid())] == [True, False]
    finally:
        container.remove(force=True)
        client.close()


def test_samples_become_metrics(tmp_path):
    folder = RunFolder(tmp_path)
    uses = iter([GpuUse(100, 0.5), GpuUse(300, 0.7), GpuUse(None, 0.9)])
    log = GpuLog(folder.gpu, lambda: next(uses))
    for time_s in (0.0, 0.1, 0.5, 1.0):
        log.sample(time_s)
    assert folder.gpu.read_text() == f"{HEADER}0.0000,100,0.5000\n0.5000,300,0.7000\n1.0000,,0.9000\n"
    metrics = _gpu_metrics(folder.gpu)
    assert metrics == {
        "gpu.memory_max": 300.0,
        "gpu.memory_mean": 200.0,
        "gpu.utilisation_mean": pytest.approx(0.7),
        "gpu.utilisation_max": 0.9,
    }


def test_a_gpu_that_cannot_be_measured_leaves_the_reason_and_no_metrics(tmp_path):
    def refuse() -> GpuUse:
        raise Unavailable("the driver is gone")

    log = GpuLog(tmp_path / "gpu.csv", refuse)
    log.sample(0.0)
    log.sample(9.0)
    assert (tmp_path / "gpu.csv").read_text() == "# not measured: the driver is gone\n"
    assert _gpu_metrics(tmp_path / "gpu.csv") == {}


class Taken(Exception):
    """All GPUs are taken."""


def refuse_to_wait() -> None:
    raise Taken


def test_each_gpu_is_leased_once_and_is_free_again(tmp_path):
    def lease():
        return lease_gpu([FIRST, SECOND], set, refuse_to_wait, tmp_path)

    with lease() as one, lease() as other:
        assert {one, other} == {FIRST, SECOND}
        with pytest.raises(Taken), lease():
            pass
    with lease() as again:
        assert again == FIRST


def test_a_gpu_of_a_container_that_outlived_its_worker_is_not_leased(tmp_path):
    with lease_gpu([FIRST, SECOND], lambda: {"GPU-first"}, refuse_to_wait, tmp_path) as gpu:
        assert gpu == SECOND


@pytest.mark.integration
def test_the_lease_of_a_killed_worker_is_free(tmp_path):
    code = (
        "import sys, time\nfrom pathlib import Path\nfrom slamhive.domain.algorithm import Gpu\n"
        "from slamhive.executors.gpu import lease_gpu\n"
        f"with lease_gpu([Gpu('GPU-first', 'm', 'd', 8)], set, sys.exit, Path({str(tmp_path)!r})):\n"
        "    print('held', flush=True)\n    time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as worker:
        assert worker.stdout is not None
        assert worker.stdout.readline() == "held\n"
        with pytest.raises(Taken), lease_gpu([FIRST], set, refuse_to_wait, tmp_path):
            pass
        worker.kill()
    with lease_gpu([FIRST], set, refuse_to_wait, tmp_path) as gpu:
        assert gpu == FIRST


def test_a_package_that_requires_a_gpu_is_refused_in_one_line_where_there_is_none(tmp_path):
    package = AlgorithmPackage("deep", tmp_path, "Deep", "1", "https://x", "MIT", "c", gpu=GpuNeed.REQUIRED)
    executor = ProcessExecutor(ExecutorContext(tmp_path, tmp_path, "installation"))
    with pytest.raises(InvalidInput) as refused:
        check_gpu(executor, package)
    assert str(refused.value) == (
        "deep requires a GPU: the executor process gives runs no GPU; choose one that does; "
        "slamhive doctor --all lists them"
    )
    for need in (GpuNeed.NONE, GpuNeed.OPTIONAL):
        check_gpu(executor, replace(package, gpu=need))


@pytest.mark.docker
def test_the_engine_takes_the_request_for_one_gpu_and_the_size_of_shared_memory(tmp_path, base_image):
    """Creating a container needs no driver, starting it does."""
    outputs = (RunOutput("result", tmp_path, "/slamhive/result"),)
    spec = RunSpec(
        uuid.uuid4().hex, 7, "deep", tmp_path, base_image, base_image, ("true",),
        (), outputs, {}, ResourceLimits(), 10.0, tmp_path / "work", gpu=FIRST.uuid, shm_bytes=2_000_000_000,
    )  # fmt: skip
    (tmp_path / "work" / "tmp").mkdir(parents=True)
    context = ExecutorContext(tmp_path, tmp_path, "installation")
    client = connect()
    container = client.containers.create(**container_options(spec, context))
    try:
        host = client.api.inspect_container(str(container.id))["HostConfig"]
        (request,) = host["DeviceRequests"]
        assert (request["DeviceIDs"], request["Capabilities"]) == ([FIRST.uuid], [["gpu"]])
        assert host["ShmSize"] == 2_000_000_000
        assert container.labels[GPU_LABEL] == FIRST.uuid
        # It does not run, so nobody else has to wait for its GPU.
        executor = DockerExecutor(context)
        assert FIRST.uuid not in executor.gpus_in_use("another run")
        executor.close()
    finally:
        container.remove(force=True)
        client.close()


@pytest.mark.docker
def test_the_gpu_of_a_running_container_is_in_use_for_other_runs_only(tmp_path, base_image):
    client = connect()
    key, gpu = uuid.uuid4().hex, f"GPU-{uuid.uuid4()}"
    labels = {KEY_LABEL: key, GPU_LABEL: gpu}
    container = client.containers.run(base_image, ["sleep", "60"], labels=labels, network_mode="none", detach=True)
    executor = DockerExecutor(ExecutorContext(tmp_path, tmp_path, "installation"))
    try:
        assert gpu in executor.gpus_in_use("another run")
        assert gpu not in executor.gpus_in_use(key)
    finally:
        container.remove(force=True)
        executor.close()
        client.close()


@pytest.mark.integration
def test_descendants_of_a_process_are_recognised():
    if str(Path("/proc/self/ns/pid").readlink()) != MACHINE_NAMESPACE:
        pytest.skip("the tests run in a container")
    child = subprocess.Popen(["/bin/sh", "-c", "sleep 60; true"])
    try:
        eventually(lambda: psutil.Process(child.pid).children(), "the child of the shell")
        (grandchild,) = psutil.Process(child.pid).children()
        belongs = below(psutil.Process())
        assert [belongs(pid) for pid in (child.pid, grandchild.pid, os.getppid())] == [True, True, False]
        assert below(psutil.Process(child.pid))(os.getpid()) is False
    finally:
        grandchild.kill()
        child.kill()
        child.wait()
    assert belongs(child.pid) is False


def test_a_node_reads_its_gpu_twice_a_second_and_gives_up_with_the_reason(monkeypatch):
    now_s = iter([0.0, 0.0, 0.1, 0.6, 0.6, 1.2, 1.2])
    monkeypatch.setattr(gpus, "monotonic_s", lambda: next(now_s))
    uses = iter([GpuUse(100, 0.5), GpuUse(None, 0.7)])

    def read() -> GpuUse:
        use = next(uses, None)
        if use is None:
            raise Unavailable("the driver is gone")
        return use

    readings = GpuReadings(read)
    assert [use_of(readings.read()) for _ in range(3)] == [GpuUse(100, 0.5), GpuUse(100, 0.5), GpuUse(None, 0.7)]
    for _ in range(2):
        with pytest.raises(Unavailable, match="the driver is gone"):
            use_of(readings.read())
    assert GpuReadings.of_run(None, psutil.Process()) is None
    unknown = GpuReadings.of_run(GivenGpu("one", "0"), psutil.Process())
    assert unknown is not None
    monkeypatch.undo()
    with pytest.raises(Unavailable, match="nobody knows the UUID of GPU 0 of one"):
        use_of(unknown.read())
    with pytest.raises(Unavailable, match="does not measure a GPU"):
        use_of(None)


@pytest.mark.integration
def test_a_job_of_slurm_passes_on_what_its_run_uses_of_the_gpu(library, tmp_path):
    """The process that measures a run on its node, with a driver that is made for the tests."""
    work, answers = tmp_path / "work", tmp_path / "answers"
    work.mkdir()
    sleep = [sys.executable, "-c", "import time; time.sleep(60)"]
    ShimSpec(sleep, {}, str(work), None, None, 64, 1000, key="key", writable=[str(work)]).save(work)
    supervisor = psutil.Process(launch(work)["pid"])
    eventually(supervisor.children, "the algorithm")
    own = [f"{process.pid} 700" for process in supervisor.children(recursive=True)][-1:]
    answers.write_text("\n".join([*own, f"{os.getpid()} 9000", "busy 25", ""]))
    gpu = GivenGpu("one", "1", "GPU-11111111-aaaa-bbbb-cccc-111111111111")
    (work / PLACE_FILE).write_text(json.dumps(dataclasses.asdict(JobPlace("one", "7", "", describe_host(), gpu))))
    environment = {**os.environ, "LD_LIBRARY_PATH": str(library), "FAKE_NVML": str(answers)}
    command = [sys.executable, "-m", "slamhive.executors.slurm.node", "measure", str(work)]
    measuring = subprocess.Popen(command, env=environment)
    try:
        eventually((work / USAGE_FILE).exists, "the first reading")
        executor = SlurmExecutor(ExecutorContext(tmp_path, tmp_path, "installation"))
        found = executor.gpu_use(RunHandle("slurm", {"work": str(work)}), gpu.uuid)
    finally:
        supervisor.send_signal(signal.SIGUSR1)
        measuring.wait(30)
    of_machine = str(Path("/proc/self/ns/pid").readlink()) == MACHINE_NAMESPACE
    assert found == GpuUse(700 if of_machine else None, 0.25)
