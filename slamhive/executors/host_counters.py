"""Counters of the machine beside a run: what others did, steal, pressure, throttling.

They are read where the run is: by the worker, by the job of Slurm on its node, or by the supervisor in a pod. That one
has the Python of the image, so this module needs no more than Python 3.7 and its standard library.

Each source may be missing: kernels without pressure information, virtual machines without frequencies. Then there is no
value, and the reason is kept.
"""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from slamhive.base.errors import Unavailable
from slamhive.run_folder.host_columns import COLUMNS

_CPU_LINE = re.compile(r"cpu(\d+)")
_STALL = re.compile(r"^some .*\btotal=(\d+)", re.MULTILINE)
_US = 1e-6

T = TypeVar("T")


@dataclass(frozen=True)
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
        """Return the time that some task has waited for ``resource`` (cpu, io or memory), out of ``/proc/pressure``."""
        path = self._proc / "pressure" / resource
        found = _STALL.search(path.read_text())
        if found is None:
            raise ValueError(f"{path} has no total")
        return int(found.group(1)) * _US

    def throttle_events(self) -> int:
        """Count how often cores, and the package with the most, became too hot and slowed down."""
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
            if self._cores is None or int(folder.name[len("cpu") :]) in self._cores
        ]
        if not chosen:
            raise ValueError(f"{self._devices} shows none of the run's cores")
        return chosen


def read_or_why(source: Callable[[], T]) -> tuple[T | None, str]:
    """Read ``source``; returns None and the reason if there is nothing."""
    try:
        return source(), ""
    except FileNotFoundError as error:
        return None, f"there is no {error.filename}"
    except OSError as error:
        return None, f"{error.filename or 'its file'} cannot be read: {error.strerror}"
    except ValueError as error:
        return None, str(error)


def sources(counters: HostCounters) -> dict[str, Callable[[], float]]:
    """Return the counters of a machine by their names in messages, ordered as the columns behind the CPU times."""
    return {
        "CPU pressure": lambda: counters.stalled_s("cpu"),
        "disk pressure": lambda: counters.stalled_s("io"),
        "memory pressure": lambda: counters.stalled_s("memory"),
        "throttling": counters.throttle_events,
        "CPU frequency": counters.frequency_hz,
    }


@dataclass(frozen=True)
class HostReading:
    """The counters at one instant.

    Attributes:
        values: In the order of ``COLUMNS``; None where the machine does not say.
        missing: Why not, by the name of what is missing.
    """

    values: tuple[float | None, ...]
    missing: dict[str, str]

    @property
    def content(self) -> dict[str, Any]:
        """Return the JSON for the worker of a run on another machine."""
        return {"values": list(self.values), "missing": self.missing}


class HostReader:
    """Reads all counters at once. What failed once is not tried again.

    Args:
        counters: Where they are read.
        interval_s: Readings closer together than this are not made.
    """

    def __init__(self, counters: HostCounters, interval_s: float = 1.0) -> None:
        self._counters = counters
        self._interval_s = interval_s
        self._next_s = float("-inf")
        self._newest = HostReading((None,) * len(COLUMNS), {})
        self._missing: dict[str, str] = {}

    def read(self, time_s: float, run_cpu_s: float | None) -> HostReading:
        """The newest reading; a new one if it is time.

        Args:
            time_s: Since the run's start.
            run_cpu_s: CPU time (s) that the run has used by now; None if nobody knows.
        """
        if time_s >= self._next_s:
            self._next_s = time_s + self._interval_s
            cpu = self._try("CPU time", self._counters.cpu)
            times = (None, None, None) if cpu is None else (cpu.cores, cpu.busy_s, cpu.steal_s)
            others = [self._try(what, source) for what, source in sources(self._counters).items()]
            self._newest = HostReading((time_s, *times, run_cpu_s, *others), dict(self._missing))
        return self._newest

    def _try(self, what: str, source: Callable[[], T]) -> T | None:
        """A value, None where there is none."""
        if what in self._missing:
            return None
        value, why = read_or_why(source)
        if why:
            self._missing[what] = why
        return value


# Energy counters of the processor packages, as the kernel shows them (RAPL: Intel, and AMD from Zen on).
#
# ``/sys/class/powercap/intel-rapl:<n>/`` holds ``name``, ``energy_uj`` (microjoules, counting up) and
# ``max_energy_range_uj``, after which the counter begins again: within the hour on a busy machine. Unverified on real
# hardware.


logger = logging.getLogger(__name__)

POWERCAP = Path("/sys/class/powercap")
HEADER = "time,package,energy_uj,range_uj\n"
NOT_MEASURED = "# not measured: "
_PACKAGE_FOLDER = re.compile(r"intel-rapl:(\d+)")


@dataclass(frozen=True)  # pods run this module with Python 3.7, which has no slots
class PackageEnergy:
    """One counter: the package's number, microjoules, and where the counter begins again."""

    package: int
    energy_uj: int
    range_uj: int


def read_packages(powercap: Path = POWERCAP) -> list[PackageEnergy]:
    """The counters of all packages; raises Unavailable that says why there are none."""
    readings = []
    try:
        for folder in sorted(powercap.iterdir()):
            number = _PACKAGE_FOLDER.fullmatch(folder.name)
            if number is None or not (folder / "name").read_text().startswith("package"):
                continue
            energy_uj, range_uj = (int((folder / name).read_text()) for name in ("energy_uj", "max_energy_range_uj"))
            readings.append(PackageEnergy(int(number.group(1)), energy_uj, range_uj))
    except FileNotFoundError as error:
        raise Unavailable(f"energy cannot be measured: there is no {error.filename}", _REMEDY) from None
    except OSError as error:
        raise Unavailable(f"energy cannot be measured: {error.filename}: {error.strerror}", _REMEDY) from None
    except ValueError as error:
        raise Unavailable(f"energy cannot be measured: {error}", _REMEDY) from None
    if not readings:
        raise Unavailable(f"energy cannot be measured: {powercap} shows no processor package", _REMEDY)
    return readings


_REMEDY = "it takes a machine with RAPL, not a virtual one, and the right to read energy_uj, which root has"


class EnergyLog:
    """Appends the counters to ``energy.csv``; where there are none, one line that says why.

    Args:
        path: ``energy.csv``.
        powercap: Where the kernel shows the counters; None where the run is not on this machine.
        interval_s: Samples closer together than this are left out.
    """

    def __init__(self, path: Path, powercap: Path | None = POWERCAP, interval_s: float = 1.0) -> None:
        self._path = path
        self._powercap = powercap
        self._interval_s = interval_s
        self._next_s: float | None = None
        self._given_up = False

    def sample(self, time_s: float, *, last: bool = False) -> None:
        """Append the counters at ``time_s`` since the run's start, if it is time for it or the ``last`` time."""
        if self._given_up or (self._next_s is not None and time_s < self._next_s and not last):
            return
        self._next_s = time_s + self._interval_s
        try:
            readings = self._read()
        except Unavailable as error:
            self._given_up = True
            self._append(f"{NOT_MEASURED}{error}\n")
            return
        rows = (f"{time_s:.4f},{entry.package},{entry.energy_uj},{entry.range_uj}\n" for entry in readings)
        self._append("".join(rows), HEADER)

    def _read(self) -> list[PackageEnergy]:
        if self._powercap is None:
            raise Unavailable("the run was on another machine than the worker")
        return read_packages(self._powercap)

    def _append(self, text: str, header: str = "") -> None:
        try:
            new = not self._path.exists()
            with self._path.open("a", encoding="utf-8") as stream:
                stream.write(header + text if new else text)
        except OSError as error:
            self._given_up = True
            logger.warning("%s: energy is not measured: %s", self._path, error.strerror)
