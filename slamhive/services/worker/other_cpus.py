"""Knowledge of a worker about nodes on which no run of its own was measured."""

from __future__ import annotations

import threading


class OtherCpus:
    """The CPU models of nodes that runs came to, but did not stay on. Safe to share between threads.

    Nobody else notes them: a run that leaves a node leaves nothing there. After a restart the worker learns them again.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._models: dict[tuple[str, str], str] = {}

    def note(self, executor: str, node: str, cpu_model: str) -> None:
        """Note the CPU model of a node."""
        with self._lock:
            self._models[executor, node] = cpu_model

    def of(self, executor: str) -> dict[str, str]:
        """{node: CPU model} of the nodes of an executor."""
        with self._lock:
            return {node: model for (name, node), model in self._models.items() if name == executor}
