"""Experiments: started, read, changed and waited for."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from slamhive.client.backend import Backend, RequestedChange, RunQuery, text_of
from slamhive.client.runs import RunList
from slamhive.documents.plain import ExperimentStatusDocument

if TYPE_CHECKING:
    from pathlib import Path

    from slamhive.documents import api
    from slamhive.documents import experiment as experiment_schema
    from slamhive.documents.experiment import Decision, SearchStanding
    from slamhive.domain.accounts import Visibility


class Experiment:
    """One experiment, as it was when it was read; :meth:`refresh` reads it again."""

    def __init__(self, backend: Backend, document: ExperimentStatusDocument) -> None:
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
    def cells(self) -> Iterator[experiment_schema.CellDocument]:
        """Its configurations, each with its runs, failures, and mean and spread of the metrics."""
        return self._backend.cells(self.name)

    @property
    def decision(self) -> Decision:
        """State of an experiment that finds out which candidate is best; raises InvalidInput for any other one."""
        return self._backend.decision(self.name)

    @property
    def search(self) -> SearchStanding:
        """State of an experiment that searches for the best candidate; raises InvalidInput for any other one."""
        return self._backend.search(self.name)

    def refresh(self) -> Experiment:
        """The experiment as it is now."""
        return Experiment(self._backend, self._backend.experiment(self.name))

    def wait(self, *, progress: bool = True) -> Experiment:
        """Wait until all runs have ended and been evaluated, or until it is paused; as for runs."""
        from slamhive.client.waiting import wait_for_experiment  # noqa: PLC0415 - reading needs none of this

        return Experiment(self._backend, wait_for_experiment(self._backend, self.name, progress=progress))

    def pause(self) -> Experiment:
        """Stop starting runs; active runs continue."""
        return self._changed(RequestedChange.PAUSE)

    def resume(self) -> Experiment:
        """Continue a paused experiment."""
        return self._changed(RequestedChange.RESUME)

    def cancel(self) -> Experiment:
        """Cancel all queued and active runs, for good."""
        return self._changed(RequestedChange.CANCEL)

    def retry_failed(self) -> Experiment:
        """Queue a new run for each failed one."""
        return self._changed(RequestedChange.RETRY_FAILED)

    def _changed(self, change: RequestedChange) -> Experiment:
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


# Analyses: written as a file, computed, and read as plots and tables.


class Analysis:
    """One stored analysis, as it was when it was read; :meth:`refresh` reads it again."""

    def __init__(self, backend: Backend, document: api.AnalysisDocument) -> None:
        self._backend = backend
        self.document = document

    def __repr__(self) -> str:
        return f"<analysis {self.name}: {self.state}>"

    @property
    def token(self) -> str:
        """Last part of the experiment's permanent address."""
        return self.document.token

    @property
    def name(self) -> str:
        """The name in its file."""
        return self.document.name

    @property
    def state(self) -> str:
        """``queued``, ``running``, ``done`` or ``failed``."""
        return self.document.state

    @property
    def reason(self) -> str | None:
        """Why it failed; None if it did not."""
        return self.document.reason

    @property
    def visibility(self) -> Visibility | None:
        """Audience of the experiment, besides admins; None for everybody who is signed in."""
        return self.document.visibility

    @property
    def yaml(self) -> str:
        """The analysis file."""
        return self._backend.analysis(self.token).yaml

    @property
    def files(self) -> tuple[str, ...]:
        """The names of its files: plots, tables, the page, and everything as a zip file. None before it is done."""
        return self._backend.analysis(self.token).files

    def file(self, name: str) -> bytes:
        """The content of one of its files; raises NotFound."""
        return self._backend.analysis_file(self.token, name)

    def report(self) -> dict[str, Any]:
        """The whole report as data: ``docs/schemas/report.schema.json``. Raises NotFound before it is done."""
        return self._backend.analysis_report(self.token)

    def refresh(self) -> Analysis:
        """The analysis as it is now."""
        return Analysis(self._backend, self._backend.analysis(self.token))

    def wait(self, *, progress: bool = True) -> Analysis:
        """Wait until it is done or has failed; returns it as it is then.

        On a data root that is open for changes, this process computes it, unless a worker does.
        """
        from slamhive.client.waiting import wait_for_analysis  # noqa: PLC0415 - reading needs none of this

        return Analysis(self._backend, wait_for_analysis(self._backend, self.token, progress=progress))

    def recompute(self) -> Analysis:
        """Queue it again, to be computed of the runs that there are now."""
        return Analysis(self._backend, self._backend.recompute_analysis(self.token))

    def share(self, visibility: str) -> Analysis:
        """Choose who may see it: ``private``, ``team`` or ``public``. It is computed again.

        Raises Forbidden unless it is one's own.
        """
        from slamhive.domain.accounts import Visibility  # noqa: PLC0415 - reading needs none of this

        return Analysis(self._backend, self._backend.share_analysis(self.token, Visibility.named(visibility)))

    def delete(self) -> None:
        """Delete it for good."""
        self._backend.delete_analysis(self.token)


class Analyses:
    """The listed analyses of an installation, the newest first."""

    def __init__(self, backend: Backend) -> None:
        self._backend = backend

    def __iter__(self) -> Iterator[Analysis]:
        return (Analysis(self._backend, document) for document in self._backend.analyses())

    def get(self, token: str) -> Analysis:
        """The analysis of a token, listed or not; raises NotFound."""
        return Analysis(self._backend, self._backend.analysis(token))

    def create(self, file: Path | str, *, listed: bool = True) -> Analysis:
        """Queue an analysis, given as the path of its file or as its text. Raises InvalidInput naming the line."""
        return Analysis(self._backend, self._backend.create_analysis(text_of(file), listed=listed))
