"""Counters of the machine beside a run, once a second into ``host.csv``: what others did, steal, pressure, throttling.

Each source may be missing: kernels without pressure information, virtual machines without frequencies. Then its column
stays empty, and one line says why.
"""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from slamhive.runs.host_load import COLUMNS, NOT_MEASURED

logger = logging.getLogger(__name__)

HEADER = ",".join(COLUMNS) + "\n"
_CPU_LINE = re.compile(r"cpu(\d+)")
_STALL = re.compile(r"^some .*\btotal=(\d+)", re.MULTILINE)
_US = 1e-6

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class CpuTimes:
    """Of some cores since the machine was started: how many they are, their busy time and what was stolen (s)."""

    cores: int
    busy_s: float
    steal_s: float


class HostCounters:
    """Reads the counters of this machine; each method raises OSError or ValueError where its source says nothing.

    Args:
        cores: The cores that the run may use, None for all.
        proc: Where the process files are mounted.
        devices: Where the kernel shows the processors.
        ticks_hz: Unit of the CPU times in ``/proc/stat``, None for that of this machine.
    """

    def __init__(
        self,
        cores: Iterable[int] | None = None,
        proc: Path = Path("/proc"),
        devices: Path = Path("/sys/devices/system/cpu"),
        ticks_hz: int | None = None,
    ) -> None:
        self._cores = None if cores is None else frozenset(cores)
        self._proc = proc
        self._devices = devices
        self._ticks_hz = ticks_hz or os.sysconf("SC_CLK_TCK")

    def cpu(self) -> CpuTimes:
        """CPU times out of ``/proc/stat``. Waiting for the disk is not busy; guests are counted as user time there."""
        cores = busy = steal = 0
        for line in (self._proc / "stat").read_text().splitlines():
            name, _, rest = line.partition(" ")
            number = _CPU_LINE.fullmatch(name)
            if number is None or (self._cores is not None and int(number.group(1)) not in self._cores):
                continue
            user, nice, system, _idle, _iowait, irq, softirq, stolen = map(int, rest.split()[:8])
            cores += 1
            busy += user + nice + system + irq + softirq
            steal += stolen
        if cores == 0:
            raise ValueError(f"{self._proc / 'stat'} shows none of the run's cores")
        return CpuTimes(cores, busy / self._ticks_hz, steal / self._ticks_hz)

    def stalled_s(self, resource: str) -> float:
        """How long some task has waited for ``resource`` (cpu, io or memory), out of ``/proc/pressure``."""
        path = self._proc / "pressure" / resource
        found = _STALL.search(path.read_text())
        if found is None:
            raise ValueError(f"{path} has no total")
        return int(found.group(1)) * _US

    def throttle_events(self) -> int:
        """How often cores, and the package with the most, became too hot and slowed down."""
        folders = [folder / "thermal_throttle" for folder in self._cpu_folders()]
        events = sum(int((folder / "core_throttle_count").read_text()) for folder in folders)
        packages = (folder / "package_throttle_count" for folder in folders)
        return events + max(int(path.read_text()) for path in packages)

    def frequency_hz(self) -> float:
        """Of the fastest core now: idle cores run slowly, which says nothing."""
        paths = (folder / "cpufreq" / "scaling_cur_freq" for folder in self._cpu_folders())
        return max(int(path.read_text()) for path in paths) * 1e3

    def _cpu_folders(self) -> list[Path]:
        chosen = [
            folder
            for folder in sorted(self._devices.glob("cpu[0-9]*"))
            if self._cores is None or int(folder.name.removeprefix("cpu")) in self._cores
        ]
        if not chosen:
            raise ValueError(f"{self._devices} shows none of the run's cores")
        return chosen


def read_or_why(source: Callable[[], T]) -> tuple[T | None, str]:
    """What ``source`` reads, or None and why there is nothing."""
    try:
        return source(), ""
    except FileNotFoundError as error:
        return None, f"there is no {error.filename}"
    except OSError as error:
        return None, f"{error.filename or 'its file'} cannot be read: {error.strerror}"
    except ValueError as error:
        return None, str(error)


def sources(counters: HostCounters) -> dict[str, Callable[[], object]]:
    """What can be recorded of a machine, by its name in messages, in the order of the columns behind the CPU times."""
    return {
        "CPU pressure": lambda: counters.stalled_s("cpu"),
        "disk pressure": lambda: counters.stalled_s("io"),
        "memory pressure": lambda: counters.stalled_s("memory"),
        "throttling": counters.throttle_events,
        "CPU frequency": counters.frequency_hz,
    }


class HostLog:
    """Appends the counters to ``host.csv``.

    Args:
        path: ``host.csv``.
        counters: Where they are read; None where the run is not on this machine.
        interval_s: Samples closer together than this are left out.
    """

    def __init__(self, path: Path, counters: HostCounters | None, interval_s: float = 1.0) -> None:
        self._path = path
        self._counters = counters
        self._interval_s = interval_s
        self._next_s: float | None = None
        self._missing: dict[str, str] = {}
        self._given_up = False

    def sample(self, time_s: float, run_cpu_s: float) -> None:
        """Append the counters at ``time_s`` since the run's start, if it is time; ``run_cpu_s``: what the run used."""
        if self._given_up or (self._next_s is not None and time_s < self._next_s):
            return
        self._next_s = time_s + self._interval_s
        if self._counters is None:
            self._append(f"{NOT_MEASURED}the run was on another machine than the worker\n")
            self._given_up = True
            return
        told = dict(self._missing)
        row = self._row(self._counters, time_s, run_cpu_s)
        news = [f"{NOT_MEASURED}{what}: {why}\n" for what, why in self._missing.items() if what not in told]
        self._append(row + "".join(news))

    def _row(self, counters: HostCounters, time_s: float, run_cpu_s: float) -> str:
        cpu = self._read("CPU time", counters.cpu)
        values = [
            *((None, None, None) if cpu is None else (cpu.cores, f"{cpu.busy_s:.3f}", f"{cpu.steal_s:.3f}")),
            f"{run_cpu_s:.4f}",
            *(self._read(what, source) for what, source in sources(counters).items()),
        ]
        return ",".join([f"{time_s:.4f}", *("" if value is None else str(value) for value in values)]) + "\n"

    def _read(self, what: str, source: Callable[[], T]) -> T | None:
        """A value, None where there is none; what failed once is not tried again."""
        if what in self._missing:
            return None
        value, why = read_or_why(source)
        if why:
            self._missing[what] = why
        return value

    def _append(self, text: str) -> None:
        try:
            new = not self._path.exists()
            with self._path.open("a", encoding="utf-8") as stream:
                stream.write(HEADER + text if new else text)
        except OSError as error:
            self._given_up = True
            logger.warning("%s: the machine is not measured: %s", self._path, error.strerror)
