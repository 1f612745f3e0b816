"""Energy counters of the processor packages, as the kernel shows them (RAPL: Intel, and AMD from Zen on).

``/sys/class/powercap/intel-rapl:<n>/`` holds ``name``, ``energy_uj`` (microjoules, counting up) and
``max_energy_range_uj``, after which the counter begins again: within the hour on a busy machine. Unverified on real
hardware.
"""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass
from pathlib import Path

from slamhive.errors import Unavailable

logger = logging.getLogger(__name__)

POWERCAP = Path("/sys/class/powercap")
HEADER = "time,package,energy_uj,range_uj\n"
NOT_MEASURED = "# not measured: "
_PACKAGE_FOLDER = re.compile(r"intel-rapl:(\d+)")


@dataclass(frozen=True, slots=True)
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
