"""The first process in the pod of a run: starts the algorithm, watches it, and records how it ended.

It runs from an archive (:mod:`slamhive.executors.kubernetes.run_files`) with the Python of the image, 3.7 or later, and
the standard library alone. What it writes lies on the storage that worker and nodes share. So the worker learns how the
run ended even if the pod, its node or the API server is gone by then.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from slamhive.executors.host_counters import HostCounters, HostReader
from slamhive.executors.kubernetes.pod_files import (
    CLAIM_FILE,
    DELIVERED_FILE,
    LOG_FOLDER,
    NODE_VARIABLE,
    ORDER_FILE,
    STARTED_FILE,
    STOP_FILE,
    USAGE_FILE,
    read_text,
    write_json,
)
from slamhive.executors.process.exit_file import CappedLog, reap, reserve, write_exit

OWN_VARIABLES = (NODE_VARIABLE, "KUBERNETES_")
"""Variables that begin so are not for the algorithm."""
INTERVAL_S = 0.1
OUTSIDE_GRACE_S = 20.0
"""Who deletes a pod gives it 30 s: some of them are needed to record the end."""
TIMEOUT_GRACE_S = 2.0
SIGNALS = (signal.SIGCHLD, signal.SIGTERM, signal.SIGINT)
_REFUSED_EXIT = 75
_NOT_STARTED_EXIT = 127


class PodSupervisor:
    """Runs one algorithm to its end. It must be the first process of its process namespace.

    Args:
        folder: Shared with the worker. ``order.json`` in it says what to do: ``command``, ``timeout_s``,
            ``log_max_bytes``, and ``pids``, ``file_bytes`` and ``cores``, which are null if not limited. With
            ``waits_for_delivery`` it stays until a courier has brought the results to the worker.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._order: dict[str, Any] = json.loads((folder / ORDER_FILE).read_text(encoding="utf-8"))
        self._exit_code: int | None = None
        self._main = 0
        self._cause = ""
        self._kill_at_s: float | None = None
        self._deadline_s = 0.0
        self._look_at_s = 0.0
        self._began_s = 0.0
        self._host = HostReader(HostCounters(self._order["cores"] or os.sched_getaffinity(0)))

    def run(self) -> int:
        """Run the algorithm; its exit code."""
        reserve(self._folder)
        kept = CappedLog(self._folder / LOG_FOLDER, self._order["log_max_bytes"])
        signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
        started_s, error = time.time(), ""
        self._began_s = time.monotonic()
        output, write_end = os.pipe()
        try:
            self._start(write_end)
        except (OSError, subprocess.SubprocessError) as problem:
            self._exit_code, error = _NOT_STARTED_EXIT, str(problem)
        finally:
            os.close(write_end)
        log = threading.Thread(target=keep_log, args=(output, kept), daemon=True)
        log.start()
        self._deadline_s = self._began_s + self._order["timeout_s"]
        if self._exit_code is None:
            write_json(self._folder / STARTED_FILE, {"started_s": started_s, **about_node()})
        while self._exit_code is None:
            self._wait()
        end_all_others()
        log.join(TIMEOUT_GRACE_S)
        self._record(started_s, error)
        # Kubernetes ends the courier soon after this process: so stay until the results are at the worker.
        while self._order.get("waits_for_delivery") and not (self._folder / DELIVERED_FILE).exists():
            found = signal.sigtimedwait(SIGNALS, INTERVAL_S)
            if found is not None and found.si_signo != signal.SIGCHLD:
                break
        return self._exit_code

    def _start(self, output: int) -> None:
        environment = {name: value for name, value in os.environ.items() if not name.startswith(OWN_VARIABLES)}
        process = subprocess.Popen(
            self._order["command"],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            env=environment,
            start_new_session=True,
            preexec_fn=self._limit,  # noqa: PLW1509 - there are no threads yet
        )
        self._main = process.pid
        process.returncode = 0  # this process reaps all others by itself

    def _limit(self) -> None:
        """Happens in the new process, before the algorithm is there."""
        signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
        if self._order["file_bytes"] is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (self._order["file_bytes"], self._order["file_bytes"]))
        if self._order["cores"] is not None:
            os.sched_setaffinity(0, self._order["cores"])

    def _wait(self) -> None:
        """Wait for a signal or the next look, and act."""
        found = signal.sigtimedwait(SIGNALS, max(0.0, self._look_at_s - time.monotonic()))
        if found is not None and found.si_signo != signal.SIGCHLD:
            self._end("outside", OUTSIDE_GRACE_S)
        self._reap()
        if self._exit_code is None and time.monotonic() >= self._look_at_s:
            self._look_at_s = time.monotonic() + INTERVAL_S
            self._look()

    def _look(self) -> None:
        asked = read_text(self._folder / STOP_FILE)
        if asked:
            self._end("asked", float(asked))
        if time.monotonic() > self._deadline_s:
            self._end("time", TIMEOUT_GRACE_S)
        if self._order["pids"] is not None and count_tasks() > self._order["pids"]:
            self._end("processes", 0.0)
        if self._kill_at_s is not None and time.monotonic() >= self._kill_at_s:
            signal_all_others(signal.SIGKILL)
        content, time_s = count_usage(), time.monotonic() - self._began_s
        try:
            reading = self._host.read(time_s, used_cpu_s(content["files"], content["own_cpu_s"]))
            write_json(self._folder / USAGE_FILE, {**content, HOST_KEY: reading.content})
        except (OSError, ValueError):
            pass  # a full disk, absent storage or a strange counter costs samples, not the run

    def _reap(self) -> None:
        for pid, status in reap():
            if pid == self._main:
                self._exit_code = 128 + os.WTERMSIG(status) if os.WIFSIGNALED(status) else os.WEXITSTATUS(status)

    def _end(self, cause: str, grace_s: float) -> None:
        """Ask all processes to end. The first cause counts; a shorter grace does so whenever it comes."""
        kill_at_s = time.monotonic() + grace_s
        if self._kill_at_s is None:
            self._cause = cause
            signal_all_others(signal.SIGTERM)
        self._kill_at_s = kill_at_s if self._kill_at_s is None else min(self._kill_at_s, kill_at_s)

    def _record(self, started_s: float, error: str) -> None:
        write_exit(
            self._folder,
            {
                "exit_code": self._exit_code,
                "out_of_memory": count_oom_kills() > 0,
                "process_limit": self._cause == "processes",
                "timed_out": self._cause == "time",
                "ended_from_outside": self._cause == "outside",
                "error": error,
                "started_s": started_s,
                "ended_s": time.time(),
            },
        )


def keep_log(output: int, log: CappedLog) -> None:
    """Write what comes out of a pipe to the log until its other end is closed."""
    while True:
        data = os.read(output, 65536)
        if not data:
            break
        try:
            log.write(data)
        except OSError:
            continue  # the algorithm must not wait for a full disk
    log.close()


def signal_all_others(number: int) -> None:
    """Send a signal to each process of the pod but this one."""
    try:
        os.kill(-1, number)
    except ProcessLookupError:
        return  # there is no other


def end_all_others() -> None:
    """Kill what the algorithm left behind, and wait until it is gone."""
    while True:
        signal_all_others(signal.SIGKILL)
        try:
            os.waitpid(-1, 0)
        except ChildProcessError:
            return


def main(folder: Path) -> int:
    """Run what ``order.json`` asks for, unless another pod did or does; the exit code."""
    if os.getpid() != 1:
        print("this is not the first process of a pod: it would end processes of others", file=sys.stderr)
        return _REFUSED_EXIT
    try:
        os.close(os.open(str(folder / CLAIM_FILE), os.O_WRONLY | os.O_CREAT | os.O_EXCL))
    except OSError as error:
        print("the run was started before, or removed: " + str(error), file=sys.stderr)
        return _REFUSED_EXIT
    return PodSupervisor(folder).run()


# -- counters of a run and its node, read by the supervisor in a pod ---------------------------------------------------


HOST_KEY = "host"
"""What the node counted, beside the usage of the run."""
USAGE_FILES = (
    "cpuacct/cpuacct.usage",
    "memory/memory.usage_in_bytes",
    "memory/memory.max_usage_in_bytes",
    "memory/memory.stat",
    "cpu.stat",
    "memory.current",
    "memory.peak",
    "memory.stat",
)
"""The files of both versions of control groups; those that are there are handed to the worker as they are."""
CGROUP = Path("/sys/fs/cgroup")
_V1_CPU, _V2_CPU = "cpuacct/cpuacct.usage", "cpu.stat"


def number_of(key: str, text: str) -> int | None:
    """Find the number after ``key`` in a file of lines with a key and a number; None if it is not there."""
    for line in text.splitlines():
        found, _, number = line.partition(" ")
        if found == key:
            return int(number)
    return None


def count_usage() -> dict[str, Any]:
    """The counters of the kernel for the container, and what of it this process used itself."""
    files = {name: read_text(CGROUP / name) for name in USAGE_FILES}
    pages = (read_text(Path("/proc/self/statm")) or "0 0 0").split()
    return {
        "own_cpu_s": time.process_time(),
        "own_bytes": (int(pages[1]) - int(pages[2])) * resource.getpagesize(),
        "files": {name: text for name, text in files.items() if text is not None},
    }


def used_cpu_s(files: Mapping[str, str], own_cpu_s: float) -> float | None:
    """CPU time of the run by the counters of its container, without the supervisor's; None if there are none.

    Raises ValueError if they make no sense.
    """
    if _V1_CPU in files:
        return max(0.0, int(files[_V1_CPU]) * 1e-9 - own_cpu_s)
    used_us = number_of("usage_usec", files.get(_V2_CPU, ""))
    return None if used_us is None else max(0.0, used_us * 1e-6 - own_cpu_s)


def count_tasks() -> int:
    """Processes and threads of the run; only processes where the kernel does not count threads for us."""
    for name in ("pids/pids.current", "pids.current"):
        text = read_text(CGROUP / name)
        if text is not None:
            return int(text) - threading.active_count()
    return sum(entry.isdigit() for entry in os.listdir("/proc")) - 1


def count_oom_kills() -> int:
    """Count the processes of the run that the kernel killed because of the memory limit."""
    for name in ("memory/memory.oom_control", "memory.events"):
        kills = number_of("oom_kill", read_text(CGROUP / name) or "")
        if kills is not None:
            return kills
    return 0


def about_node() -> dict[str, Any]:
    """The node, and what its processor, memory and kernel are."""
    lines = (read_text(Path("/proc/cpuinfo")) or "").splitlines()
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return {
        "node": os.environ.get(NODE_VARIABLE, ""),
        "cpu": models[0] if models else "unknown",
        "cores": os.cpu_count(),
        "memory_bytes": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
        "kernel": os.uname().release,
        "gpu": os.environ.get("NVIDIA_VISIBLE_DEVICES", ""),
    }


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
