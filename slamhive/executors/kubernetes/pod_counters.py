"""Counters of a run and its node, read by the supervisor in a pod.

As the supervisor, it needs no more than Python 3.7 and its standard library.
"""

from __future__ import annotations

import os
import resource
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from slamhive.executors.kubernetes.pod_files import NODE_VARIABLE, read_text

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
