"""CPU and memory of a container from the engine's statistics, where its control group is on another machine."""

from __future__ import annotations

from typing import Any

import docker.errors

from slamhive.executors.base import EngineUnavailable
from slamhive.executors.cgroup import file_cache_bytes, present
from slamhive.executors.docker.engine import engine_errors

_NS = 1e-9


class DockerStatsSource:
    """Asks for one reading at a time; the engine's own peak counter is there under control groups version 1 only."""

    on_this_machine = False

    def __init__(self, container: Any) -> None:
        self._container = container
        self._totals: dict[str, float] = {}

    def read(self) -> tuple[float, int] | None:
        """CPU time (s) and memory in use (bytes); None once the container has ended."""
        with engine_errors("reading statistics", EngineUnavailable):
            try:
                stats = self._container.stats(stream=False, one_shot=True)
            except docker.errors.NotFound:
                return None
        usage = parse_stats(stats)
        if usage is not None:
            self._totals |= present({"ram.charged_max": stats["memory_stats"].get("max_usage")})
        return usage

    def totals(self) -> dict[str, float]:
        """Return the counters of the last reading."""
        return self._totals

    def close(self) -> None:
        """Nothing is held open."""


def parse_stats(stats: dict[str, Any]) -> tuple[float, int] | None:
    """CPU time (s) and memory in use (bytes) of one reading; None for a container that does not run."""
    memory = stats.get("memory_stats") or {}
    if "usage" not in memory:
        return None
    cache = file_cache_bytes(memory.get("stats") or {})
    cpu_s = stats["cpu_stats"]["cpu_usage"]["total_usage"] * _NS
    return cpu_s, max(0, memory["usage"] - cache)
