"""Samples CPU and memory of a run into ``profiling.csv`` from a thread of the worker.

One line every interval: ``time,cpu_usage,memory_usage``: seconds since the run's start, cores in use since the line
before (summed over all cores), bytes. CPU comes from a counter of CPU time, so nothing between two samples is missed.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from slamhive.base.clock import monotonic_s
from slamhive.executors.base import EngineUnavailable
from slamhive.executors.gpu import GpuLog
from slamhive.executors.host_counters import EnergyLog
from slamhive.executors.host_log import HostLog
from slamhive.executors.status import UsageSource

logger = logging.getLogger(__name__)

HEADER = "time,cpu_usage,memory_usage\n"


@dataclass(frozen=True, slots=True)
class MachineLogs:
    """Where the counters of the machine go while a run is sampled."""

    energy: EnergyLog
    host: HostLog
    gpu: GpuLog | None = None


class Sampler:
    """Reads a usage source at a fixed rate until it has nothing more to say or :meth:`stop` is called.

    A file that is there already (the worker was restarted) is continued; the time that nobody sampled is a gap in it.

    Args:
        source: What is sampled; closed at the end.
        path: ``profiling.csv``.
        interval_s: Time between samples.
        offset_s: How long the run has been going on already.
        clock: Monotonic seconds.
        machine: Where the counters of the machine go meanwhile.
    """

    def __init__(
        self,
        source: UsageSource,
        path: Path,
        interval_s: float = 0.1,
        offset_s: float = 0.0,
        clock: Callable[[], float] = monotonic_s,
        machine: MachineLogs | None = None,
    ) -> None:
        self._source = source
        self._path = path
        self._interval_s = interval_s
        self._clock = clock
        self._machine = machine
        self._origin_s = clock() - offset_s
        self._totals: dict[str, float] = {}
        self.most_bytes: int | None = None
        """The most memory of the samples so far, None before the first."""
        self.ends = threading.Event()
        """Set when sampling is to end; between samples, it is waited for."""
        self._thread = threading.Thread(target=self._run, name=f"sampler {path.parent.name}", daemon=True)

    def start(self) -> None:
        """Begin to sample."""
        self._thread.start()

    def stop(self) -> dict[str, float]:
        """End, and return the totals that the kernel recorded of the run, as last read: {metric: value}."""
        self.ends.set()
        if self._thread.ident is not None:
            self._thread.join()
        return self._totals

    def _run(self) -> None:
        try:
            with self._open() as stream:
                self._sample(stream)
        except OSError as error:
            logger.warning("%s: sampling ends: %s", self._path, error.strerror)
        except EngineUnavailable as error:
            logger.warning("%s: sampling ends: %s", self._path, str(error))
        finally:
            self._source.close()
            self._note_energy(last=True)

    def _open(self) -> IO[str]:
        """``profiling.csv`` for appending; a line that a killed worker left half-written is ended first."""
        if not self._path.exists() or self._path.stat().st_size == 0:
            stream = self._path.open("w", encoding="ascii", buffering=1)
            stream.write(HEADER)
            return stream
        with self._path.open("rb+") as existing:
            content = existing.read()
            existing.truncate(content.rfind(b"\n") + 1)
        return self._path.open("a", encoding="ascii", buffering=1)

    def _note_energy(self, *, last: bool = False) -> None:
        if self._machine is not None:
            self._machine.energy.sample(self._clock() - self._origin_s, last=last)

    def _sample(self, stream: IO[str]) -> None:
        before: tuple[float, float] | None = None
        due_s = self._clock()
        while not self.ends.is_set():
            usage = self._source.read()
            now_s = self._clock()
            if usage is None:
                return
            cpu_s, memory_bytes = usage
            self.most_bytes = max(memory_bytes, self.most_bytes or 0)
            if before is not None and now_s > before[0]:
                cores = max(0.0, cpu_s - before[1]) / (now_s - before[0])
                stream.write(f"{now_s - self._origin_s:.4f},{cores:.4f},{memory_bytes}\n")
            before = (now_s, cpu_s)
            if self._machine is not None:
                self._machine.host.sample(now_s - self._origin_s, cpu_s)
                if self._machine.gpu is not None:
                    self._machine.gpu.sample(now_s - self._origin_s)
            self._note_energy()
            for metric, value in self._source.totals().items():
                self._totals[metric] = max(value, self._totals.get(metric, 0.0))
            due_s += self._interval_s
            if due_s - now_s < self._interval_s / 2:
                due_s = now_s + self._interval_s  # Samples close together would tell of the counter's steps.
            self.ends.wait(due_s - now_s)
