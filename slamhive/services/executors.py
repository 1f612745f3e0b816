"""The executors of one installation: opened once, chosen by name or by the settings."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from slamhive.base.settings import Settings
from slamhive.evaluation.runner import EvaluationRunner
from slamhive.executors.base import Executor, ExecutorContext, NodeAccess
from slamhive.executors.registry import (
    AUTO,
    candidates,
    choose_executor,
    given_options,
    installation_id,
    open_executor,
)

NO_INSTALLATION = "none"
"""The identifier of a data root that does not exist yet: nothing was ever started for it."""


class Executors:
    """Opens and chooses executors.

    Args:
        settings: Name the executor to use unless a run asks for another one.
        project_root: Folder with ``algorithms/`` and ``docker/``.
        worker_alive: Whether a worker of this data root is running on this machine.

    Attributes:
        opened: The executors in use, by name.
    """

    def __init__(self, settings: Settings, project_root: Path, worker_alive: Callable[[], bool]) -> None:
        self._settings = settings
        self._project_root = project_root
        self._worker_alive = worker_alive
        self.opened: dict[str, Executor] = {}

    def get(self, name: str) -> Executor:
        """The executor called ``name``, opened on first use; raises NotFound that lists the choices."""
        if name not in self.opened:
            self.opened[name] = open_executor(name, self._context(name))
        return self.opened[name]

    def choose(self, asked: str | None = None) -> str:
        """The name of the executor that a run will use: ``asked``, or the one of the settings.

        While a worker is running, the executor of the settings is not checked: a web server in its own container cannot
        reach the worker's engine. Otherwise raises Unavailable, with the remedy, if the executor cannot be used here or
        in this mode.
        """
        wanted = asked or self._settings.executor
        if wanted == self._settings.executor != AUTO and not self._elsewhere and self._worker_alive():
            return wanted
        return self._chosen(wanted)[0].name

    def usable(self) -> list[Executor]:
        """The executors that can be used now without being asked for by name, the preferred one first."""
        found = candidates(AUTO, self.get, elsewhere=self._elsewhere)
        return [entry for entry in found if entry.unavailable_because() is None]

    def default(self) -> tuple[str, str]:
        """The name of the executor in use and the reason for it in words."""
        executor, reason = self._chosen(self._settings.executor)
        return executor.name, reason

    def evaluation_runner(self) -> EvaluationRunner:
        """Evaluations run where the executor in use wants them."""
        executor, _ = self._chosen(self._settings.executor)
        return EvaluationRunner(executor.evaluation_starter())

    def close(self) -> None:
        """Close the connections to engines."""
        for executor in self.opened.values():
            executor.close()
        self.opened.clear()

    @property
    def _elsewhere(self) -> bool:
        return self._settings.mode.has_other_machines

    def _chosen(self, wanted: str) -> tuple[Executor, str]:
        return choose_executor(wanted, self.get, elsewhere=self._elsewhere)

    def _node_access(self) -> NodeAccess:
        from slamhive.executors.node_store.controller import node_access  # noqa: PLC0415 - loads pydantic

        return node_access(self._settings)

    def _context(self, name: str) -> ExecutorContext:
        data, archives = self._settings.data, self._settings.source_archives
        return ExecutorContext(
            data=data,
            project_root=self._project_root,
            installation=installation_id(data) if data.is_dir() else NO_INSTALLATION,
            log_max_bytes=self._settings.log_max_bytes,
            source_archives=Path(archives) if archives else None,
            nodes=None if self._settings.shared_storage else self._node_access(),
            options=given_options(name, self._settings.further),
        )
