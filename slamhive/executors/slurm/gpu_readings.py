"""The use of the GPU that Slurm gave a run: read on the node, passed to the worker in ``usage.json``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

import psutil

from slamhive.clock import monotonic_s
from slamhive.domain.gpu import GivenGpu
from slamhive.errors import Unavailable
from slamhive.executors.gpu import GpuUse, below, gpu_use

INTERVAL_S = 0.5
"""NVML is asked no more often than this: its driver samples the utilisation a few times a second."""
_WHY_NOT = "why_not"


class GpuReadings:
    """Readings as the content of JSON.

    Args:
        read: One reading; raises Unavailable, and is not called again then.
    """

    def __init__(self, read: Callable[[], GpuUse]) -> None:
        self._read = read
        self._content: dict[str, Any] = {}
        self._next_s = 0.0

    @classmethod
    def of_run(cls, gpu: GivenGpu | None, supervisor: psutil.Process) -> GpuReadings | None:
        """Those of the processes that ``supervisor`` has started; None without a GPU."""
        if gpu is None:
            return None
        belongs = below(supervisor)

        def read() -> GpuUse:
            if gpu.uuid is None:
                raise Unavailable(f"nobody knows the UUID of GPU {gpu.number} of {gpu.node}")
            return gpu_use(gpu.uuid, belongs)

        return cls(read)

    def read(self) -> dict[str, Any]:
        """The newest reading, or why there is none."""
        if _WHY_NOT in self._content or monotonic_s() < self._next_s:
            return self._content
        self._next_s = monotonic_s() + INTERVAL_S
        try:
            self._content = asdict(self._read())
        except Unavailable as error:
            self._content = {_WHY_NOT: str(error)}
        return self._content


def use_of(content: Mapping[str, Any] | None) -> GpuUse:
    """Parse the result of :meth:`GpuReadings.read`; raises Unavailable with the reason."""
    if content is None:
        raise Unavailable("the job of Slurm does not measure a GPU")
    if _WHY_NOT in content:
        raise Unavailable(content[_WHY_NOT])
    return GpuUse(**content)
