"""A description of this machine, for the provenance of each run."""

from __future__ import annotations

import os
import platform
from pathlib import Path

import psutil

from slamhive.domain.host import Host


def describe_host() -> Host:
    """Describe this machine; ``cpu_count`` counts logical cores."""
    return Host(
        cpu_model=_cpu_model(Path("/proc/cpuinfo")),
        cpu_count=os.cpu_count() or 1,
        memory_bytes=int(psutil.virtual_memory().total),
        kernel=platform.release(),
        os=_os_name(),
    )


def _cpu_model(cpuinfo: Path) -> str:
    try:
        for line in cpuinfo.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def _os_name() -> str:
    try:
        return platform.freedesktop_os_release().get("PRETTY_NAME", platform.system())
    except OSError:
        return platform.system()
