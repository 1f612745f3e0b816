"""Experiments: started, read, changed and waited for."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from slamhive.client.backend import Backend, Change, RunQuery, text_of
from slamhive.client.runs import RunList

if TYPE_CHECKING:
    from pathlib import Path

    from slamhive.schema import experiment as experiment_schema


class Experiment:
    """One experiment, as it was when it was read; :meth:`refresh` reads it again."""

    def __init__(self, backend: Backend, document: experiment_schema.ExperimentStatus) -> None:
        self._backend = backend
        self.document = document

    def __repr__(self) -> str:
        return f"<experiment {self.name}: {self.document.runs} runs, {self.state}>"

    @property
    def name(self) -> str:
        """Its name."""
        return self.document.name

    @property
    def state(self) -> str:
        """``storing``, ``active``, ``paused``, ``cancelled`` or ``finished``."""
        return self.document.state

    @property
    def runs(self) -> RunList:
        """Its runs, the newest first."""
        quoted = self.name.replace("\\", "\\\\").replace('"', '\\"')
        return RunList(self._backend, RunQuery(f'experiment = "{quoted}"'))

    @property
    def cells(self) -> Iterator[experiment_schema.Cell]:
        """Its configurations, each with its runs, failures, and mean and spread of the metrics."""
        return self._backend.cells(self.name)

    def refresh(self) -> Experiment:
        """The experiment as it is now."""
        return Experiment(self._backend, self._backend.experiment(self.name))

    def wait(self, *, progress: bool = True) -> Experiment:
        """Wait until all runs have ended and been evaluated, or until it is paused; as for runs."""
        from slamhive.client.waiting import wait_for_experiment  # noqa: PLC0415 - reading needs none of this

        return Experiment(self._backend, wait_for_experiment(self._backend, self.name, progress=progress))

    def pause(self) -> Experiment:
        """Stop starting runs; active runs continue."""
        return self._changed(Change.PAUSE)

    def resume(self) -> Experiment:
        """Continue a paused experiment."""
        return self._changed(Change.RESUME)

    def cancel(self) -> Experiment:
        """Cancel all queued and active runs, for good."""
        return self._changed(Change.CANCEL)

    def retry_failed(self) -> Experiment:
        """Queue a new run for each failed one."""
        return self._changed(Change.RETRY_FAILED)

    def _changed(self, change: Change) -> Experiment:
        return Experiment(self._backend, self._backend.change(self.name, change))


class Experiments:
    """The experiments of an installation, the newest first."""

    def __init__(self, backend: Backend) -> None:
        self._backend = backend

    def __iter__(self) -> Iterator[Experiment]:
        return (Experiment(self._backend, document) for document in self._backend.experiments())

    def get(self, name: str) -> Experiment:
        """The experiment of a name; raises NotFound."""
        return Experiment(self._backend, self._backend.experiment(name))

    def start(self, file: Path | str, executor: str | None = None) -> Experiment:
        """Queue all runs of an experiment, given as the path of its file or as its text.

        The same again completes an interrupted start; no run is queued twice. Raises InvalidInput or NotFound naming
        the line.
        """
        return Experiment(self._backend, self._backend.start(text_of(file), executor))
