from __future__ import annotations

import json
import math
import os
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import docker
import pytest
import requests

from slamhive.base.errors import NotFound, Unavailable
from slamhive.domain.algorithm import AlgorithmPackage, RunUser
from slamhive.executors.base import Capabilities, EngineUnavailable, ExecutorContext, ImageMissing, StartFailed
from slamhive.executors.docker.containers import container_options, engine_protections, in_words, is_foreign
from slamhive.executors.docker.engine import (
    EngineTraits,
    connect,
    container_name,
    engine_errors,
    information_of,
    lifetime,
    statistics_of,
    traits_of,
)
from slamhive.executors.docker.executor import DockerStatsSource, parse_stats
from slamhive.executors.docker.images import follow_build
from slamhive.executors.process.environment import Environments
from slamhive.executors.process.exit_file import CappedLog, assemble
from slamhive.executors.registry import EXECUTORS, choose_executor, installation_id, open_executor
from slamhive.executors.sampler import HEADER, Sampler
from slamhive.executors.spec import Limit, ResourceLimits, RunOutput, RunSpec


@pytest.fixture
def context(tmp_path: Path) -> ExecutorContext:
    return ExecutorContext(tmp_path, tmp_path, "installation-1", 100_000)


def package(folder: Path, **changes) -> AlgorithmPackage:
    return AlgorithmPackage("demo", folder, "Demo", "1", "", "", "", **changes)


def spec(tmp_path: Path, limits: ResourceLimits) -> RunSpec:
    outputs = (RunOutput("result", tmp_path, "/slamhive/result"),)
    return RunSpec(
        "key", 7, "demo", tmp_path, "image:tag", "sha256:abc", ("python3", "/slamhive/mapping.py"),
        (), outputs, {"A": "b"}, limits, 10.0, tmp_path / "work",
    )  # fmt: skip


class Choice:
    """As much of an executor as the choice looks at."""

    def __init__(self, name: str, problem: str | None, preference: int | None, *, elsewhere: bool = False) -> None:
        self.name = name
        self.capabilities = Capabilities(preference=preference, elsewhere=elsewhere)
        self._problem = problem

    def unavailable_because(self) -> str | None:
        return self._problem


def executors(docker: str | None, process: str | None) -> Any:
    return found(docker=Choice("docker", docker, 10), process=Choice("process", process, 20))


def found(**made: Choice) -> Any:
    """Finds the executors that are made for a test; those that ship otherwise must be asked for by name."""
    others = {name: Choice(name, None, None) for name in EXECUTORS.names() if name not in made}
    return (others | made).__getitem__


def test_auto_prefers_the_lowest_number_and_says_why_not():
    assert choose_executor("auto", executors(None, None))[0].name == "docker"
    executor, reason = choose_executor("auto", executors("no engine answers", None))
    assert (executor.name, reason) == ("process", "process, because no engine answers")
    with pytest.raises(Unavailable, match=r"no engine answers.*no pip"):
        choose_executor("auto", executors("no engine answers", "no pip"))


def test_auto_never_takes_an_executor_without_preference():
    process: Any = Choice("process", None, 20)
    find = found(docker=Choice("docker", None, None), process=process)
    assert choose_executor("auto", find) == (process, "process, the first choice")


def test_auto_does_not_make_executors_that_must_be_asked_for_by_name():
    asked: list[str] = []

    def find(name: str) -> Any:
        asked.append(name)
        return Choice(name, None, 10)

    choose_executor("auto", find)
    assert asked == ["docker", "process"]


def test_elsewhere_only_executors_of_other_machines_are_taken():
    grid: Any = Choice("slurm", None, None, elsewhere=True)
    find = found(slurm=grid)
    assert choose_executor("auto", find, elsewhere=True) == (grid, "slurm, the first choice")
    assert choose_executor("slurm", find, elsewhere=True)[0] is grid
    with pytest.raises(Unavailable, match="the executor docker runs algorithms on this machine only") as refused:
        choose_executor("docker", find, elsewhere=True)
    assert "choose one of: slurm" in str(refused.value)
    with pytest.raises(Unavailable, match="no executor can be used: slurm: no sbatch"):
        choose_executor("auto", found(slurm=Choice("slurm", "no sbatch", None, elsewhere=True)), elsewhere=True)


def test_named_executor():
    find = executors("no engine answers", None)
    assert choose_executor("process", find)[0].name == "process"
    with pytest.raises(Unavailable, match="no engine answers"):
        choose_executor("docker", find)


def test_limits_that_are_not_enforced_are_refused_in_words():
    some = Capabilities(limits=frozenset({Limit.CORES}))
    assert some.refusal("plain", ResourceLimits(cpu_cores=1.0, pids=None)) is None
    refusal = some.refusal("plain", ResourceLimits(memory_bytes=1, pids=5))
    assert refusal == "the executor plain does not limit memory and processes"
    assert ResourceLimits(1.0, 1, 5, (0,), 1, 1).only(some.limits) == ResourceLimits(
        cpu_cores=1.0, pids=None, cpuset=(0,)
    )


def test_unknown_executor_lists_the_choices(context):
    with pytest.raises(NotFound, match="docker"):
        open_executor("dockr", context)


def test_installation_id_stays(tmp_path):
    assert installation_id(tmp_path / "data") == installation_id(tmp_path / "data")


def test_container_names():
    assert container_name("abc-1") == "slamhive-abc-1"
    long = [container_name("x" * 80 + end) for end in "ab"]
    assert len(set(long)) == 2
    assert all(len(name) <= 63 for name in long)
    assert container_name("a/b") != container_name("a-b")


def test_container_options_are_hardened(tmp_path, context):
    options = container_options(spec(tmp_path, ResourceLimits(1.5, 2_000_000_000, 64, (0, 2))), context)
    assert options["cap_drop"] == ["ALL"]
    assert options["security_opt"] == ["no-new-privileges"]
    assert options["network_mode"] == "none"
    assert options["init"] is True
    assert options["image"] == "sha256:abc"
    assert options["entrypoint"] == ["python3", "/slamhive/mapping.py"]
    assert options["memswap_limit"] == options["mem_limit"] == 2_000_000_000
    assert (options["nano_cpus"], options["cpuset_cpus"], options["pids_limit"]) == (1_500_000_000, "0,2", 64)
    assert options["environment"]["ROS_MASTER_URI"] == "http://localhost:11311"
    assert options["labels"] == {
        "slamhive.key": "key",
        "slamhive.run": "7",
        "slamhive.installation": "installation-1",
    }


def test_root_of_a_rootless_engine_is_the_worker(tmp_path, context):
    """Any other number in its containers owns nothing here, so the run could not write its result."""
    limits = ResourceLimits(1.5, 2_000_000_000, 64, (0, 2))
    options = container_options(spec(tmp_path, limits), context, EngineTraits(rootless=True, limits_cpu=False))
    assert options["user"] == "0:0"
    assert options["environment"]["HOME"] == "/tmp"
    assert "nano_cpus" not in options  # the engine would refuse the container
    assert options["mem_limit"] == 2_000_000_000
    words = in_words(RunUser.WORKER, rootless=True)
    assert words.startswith(f"user {os.getuid()}:{os.getgid()} of the worker")
    assert not is_foreign(RunUser.ROOT, rootless=True)
    assert is_foreign(RunUser.IMAGE, rootless=True)


@pytest.mark.parametrize(
    ("info", "traits"),
    [
        ({"SecurityOptions": ["name=seccomp,profile=default"], "CpuCfsQuota": True}, EngineTraits()),
        (
            {
                "SecurityOptions": ["name=seccomp,profile=default", "name=rootless", "name=cgroupns"],
                "CpuCfsQuota": False,
            },
            EngineTraits(rootless=True, limits_cpu=False),
        ),
        ({"SecurityOptions": None}, EngineTraits()),
    ],
)
def test_what_an_engine_says_of_itself(info, traits):
    client: Any = SimpleNamespace(info=lambda: info)
    assert traits_of(client) == traits


ENDED = "ended-container"
PODMAN: dict[str, Any] = {
    "/v1.41/info": {
        "SecurityOptions": ["name=apparmor", "name=seccomp,profile=default"],
        "CgroupVersion": "2",
        "CpuCfsQuota": False,
        "PidsLimit": True,
        "MemoryLimit": True,
        "Rootless": True,
    },
    "/v4.0.0/libpod/info": {"host": {"cgroupControllers": ["cpu", "memory", "pids"]}},
    f"/v1.41/containers/{ENDED}/json": {"Id": ENDED},
    f"/v1.41/containers/{ENDED}/stats": None,
}
"""Answers that Podman 4.3.1 of Debian 12 gave to a user without root; None for a body without a byte."""


class _Podman(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        found = PODMAN[self.path.partition("?")[0]]
        body = b"" if found is None else json.dumps(found).encode()
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_words: object) -> None:
        """Say nothing."""


@pytest.fixture
def podman():
    with ThreadingHTTPServer(("127.0.0.1", 0), _Podman) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        client = docker.DockerClient(base_url=f"tcp://127.0.0.1:{server.server_port}", version="1.41")
        yield client
        client.close()
        server.shutdown()


def test_podman_without_root_is_an_engine_without_root_that_limits_cpu_time(podman):
    assert traits_of(podman) == EngineTraits(rootless=True, limits_cpu=True)
    protections = engine_protections(information_of(podman))
    assert protections.cpu == "enforced by the kernel (cpu.max)"


def test_podman_without_the_controller_limits_no_cpu_time(podman, monkeypatch):
    monkeypatch.setitem(PODMAN, "/v4.0.0/libpod/info", {"host": {"cgroupControllers": ["memory", "pids"]}})
    assert traits_of(podman) == EngineTraits(rootless=True, limits_cpu=False)


def test_podman_sends_nothing_about_a_container_that_has_ended(podman):
    ended = podman.containers.get(ENDED)
    assert statistics_of(ended) == {}
    assert DockerStatsSource(ended).read() is None


def test_no_limit_means_no_option(tmp_path, context):
    assert {"mem_limit", "nano_cpus", "cpuset_cpus"}.isdisjoint(
        container_options(spec(tmp_path, ResourceLimits()), context)
    )


def test_failed_build_names_step_and_last_lines():
    events = [
        {"stream": "Step 1/2 : FROM base\n"},
        {"stream": " ---> abc\n"},
        {"stream": "Step 2/2 : RUN false\n"},
        {"stream": "\x1b[91msomething\n\x1b[0m"},
        {"stream": "  went wrong\n"},
        {"error": "The command returned a non-zero code: 1"},
    ]
    lines: list[str] = []
    with pytest.raises(ImageMissing, match=r"Step 2/2 : RUN false: something \| went wrong \| The command"):
        follow_build(events, "demo", lines.append)
    assert lines[0] == "demo: Step 1/2 : FROM base"


def test_an_absent_engine_is_refused_without_a_socket_left_open(monkeypatch, tmp_path):
    monkeypatch.setenv("DOCKER_HOST", f"unix://{tmp_path}/docker.sock")
    with pytest.raises(EngineUnavailable, match="no Docker engine answers"):
        connect()  # an open socket would be a ResourceWarning, which fails the test


def test_connection_errors_mean_engine_unavailable():
    with pytest.raises(EngineUnavailable, match="starting"), engine_errors("starting", StartFailed):
        raise requests.exceptions.ConnectionError("refused")


def test_stats_of_both_versions():
    cpu = {"cpu_usage": {"total_usage": 3_000_000_000}}
    old = {
        "cpu_stats": cpu,
        "memory_stats": {"usage": 100, "stats": {"total_cache": 50, "total_shmem": 10, "cache": 1}},
    }
    new = {"cpu_stats": cpu, "memory_stats": {"usage": 100, "stats": {"file": 35, "shmem": 5, "inactive_file": 1}}}
    assert parse_stats(old) == (3.0, 60)
    assert parse_stats(new) == (3.0, 70)
    assert parse_stats({"cpu_stats": cpu, "memory_stats": {}}) is None


def test_log_keeps_head_and_tail(tmp_path):
    log = CappedLog(tmp_path / "log", 100)
    for number in range(100):
        log.write(f"line {number:03d}\n".encode())
    log.close()
    text = assemble(tmp_path / "log").decode()
    assert text.startswith("line 000\n")
    assert text.endswith("line 099\n")
    kept = len(text.replace(text[text.index("\n[...") : text.index("...]\n") + 5], ""))
    left_out = int(text.partition("[... ")[2].split()[0])
    assert kept + left_out == 900
    assert kept <= 100


def test_short_log_is_whole(tmp_path):
    log = CappedLog(tmp_path / "log", 100)
    log.write(b"x" * 60)
    log.close()
    assert assemble(tmp_path / "log") == b"x" * 60
    assert assemble(tmp_path / "absent") == b""


def test_environment_needs_requirements(tmp_path):
    with pytest.raises(ImageMissing, match=r"requirements\.txt.*use an executor of containers"):
        Environments(tmp_path).identity(package(tmp_path))


def test_environment_follows_requirements_and_prepare(tmp_path):
    environments = Environments(tmp_path / "data")
    (tmp_path / "requirements.txt").write_text("")
    first = environments.identity(package(tmp_path))
    (tmp_path / "README.md").write_text("words")
    assert environments.identity(package(tmp_path)) == first
    (tmp_path / "prepare.py").write_text("")
    second = environments.identity(package(tmp_path))
    (tmp_path / "requirements.txt").write_text("numpy\n")
    third = environments.identity(package(tmp_path))
    (package(tmp_path).folder / "requirements-no-deps.txt").write_text("numpy\n")
    assert len({first, second, third, environments.identity(package(tmp_path))}) == 4


def test_missing_library_names_the_apt_packages(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    (tmp_path / "requirements.txt").write_text("")
    wanted = package(tmp_path, system_libraries=("libnotthere.so.9",), system_packages=("libnotthere9",))
    with pytest.raises(ImageMissing, match=r"libnotthere\.so\.9.*sudo apt-get install libnotthere9"):
        Environments(tmp_path / "data").build(wanted, lambda line: None)


class Readings:
    """A usage source of given readings."""

    on_this_machine = True

    def __init__(self, *readings: tuple[float, int]) -> None:
        self._left = list(readings)
        self.closed = False

    def read(self) -> tuple[float, int] | None:
        return self._left.pop(0) if self._left else None

    def totals(self) -> dict[str, float]:
        return {"ram.charged_max": 500.0 - len(self._left)}

    def close(self) -> None:
        self.closed = True


def test_sampler_appends_behind_a_torn_line(tmp_path):
    path = tmp_path / "profiling.csv"
    path.write_text(HEADER + "0.1,1.0,5\n0.2,1.")
    source = Readings((0.0, 10), (1.0, 20), (1.0, 30))
    sampler = Sampler(source, path, interval_s=0.01, offset_s=100.0)
    sampler.start()
    sampler._thread.join(5)
    assert sampler.stop() == {"ram.charged_max": 500.0}, "no total falls"
    assert source.closed
    lines = path.read_text().splitlines()
    assert lines[:2] == [HEADER.strip(), "0.1,1.0,5"]
    assert [line.split(",")[2] for line in lines[2:]] == ["20", "30"]
    assert float(lines[2].split(",")[0]) == pytest.approx(100.0, abs=1.0)
    assert float(lines[2].split(",")[1]) > 1


class LateReadings:
    """One busy core behind a counter with steps of 10 ms, whose second reading comes late; time is simulated."""

    on_this_machine = True

    def __init__(self, readings: int, late_s: float) -> None:
        self.now_s = 0.0
        self._left = readings
        self._late = {readings - 2: late_s}
        self.closed = threading.Event()

    def read(self) -> tuple[float, int] | None:
        self._left -= 1
        self.now_s += 0.001 + self._late.get(self._left, 0.0)
        return None if self._left < 0 else (math.floor(self.now_s * 100 + 1e-9) / 100, 1)

    def totals(self) -> dict[str, float]:
        return {}

    def close(self) -> None:
        self.closed.set()


@pytest.mark.parametrize("late_s", [0.0, 0.05, 0.095, 0.15, 0.19, 3.0])
def test_a_late_sample_is_not_followed_by_one_at_once(tmp_path, monkeypatch, late_s):
    source = LateReadings(20, late_s)
    sampler = Sampler(source, tmp_path / "profiling.csv", interval_s=0.1, clock=lambda: source.now_s)

    class Clockwork(threading.Event):
        def wait(self, timeout: float | None = None) -> bool:
            source.now_s += timeout or 0.0
            return False

    monkeypatch.setattr(sampler, "ends", Clockwork())
    sampler.start()
    assert source.closed.wait(5)
    cores = [float(line.split(",")[1]) for line in (tmp_path / "profiling.csv").read_text().splitlines()[1:]]
    assert len(cores) == 19
    assert max(cores) <= 1.25


@pytest.mark.parametrize(
    ("state", "seconds"),
    [
        # As Docker 20.10 has reported it of a container that ended at once.
        ({"StartedAt": "2026-11-24T12:39:24.774949311Z", "FinishedAt": "2026-11-24T12:39:24.773853202Z"}, 0.0),
        ({"StartedAt": "2026-11-24T12:39:24Z", "FinishedAt": "2026-11-24T12:39:25.5Z"}, 1.5),
    ],
)
def test_no_container_ends_before_it_starts(state, seconds):
    started_at, ended_at = lifetime(state)
    assert started_at is not None
    assert ended_at is not None
    assert (ended_at - started_at).total_seconds() == seconds


def test_a_container_that_was_never_started_has_no_times():
    assert lifetime({"StartedAt": "0001-01-01T00:00:00Z", "FinishedAt": "0001-01-01T00:00:00Z"}) == (None, None)
