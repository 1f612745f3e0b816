"""The use cases of experiments, as command line, web pages and web API call them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from slamhive.domain.parameters import Value
from slamhive.errors import Conflict, SlamHiveError
from slamhive.services.datasets import check_writable
from slamhive.services.experiments import status as statuses
from slamhive.services.experiments.axis_table import AxisTables
from slamhive.services.experiments.changing import put_state, retry_failed
from slamhive.services.experiments.context import ExperimentContext, Progress, silent
from slamhive.services.experiments.previewing import preview
from slamhive.services.experiments.restoring import Restored, restore_rows, restore_runs
from slamhive.services.experiments.starting import add_repeats, check_same, start
from slamhive.services.experiments.time_left import TimeLeft
from slamhive.services.experiments.views import (
    Cell,
    CellPage,
    ExperimentPreview,
    ExperimentSource,
    ExperimentStatus,
    Grid,
    Standing,
)
from slamhive.store import Transaction
from slamhive.store.experiment_records import ExperimentState
from slamhive.sweep.experiment_file import parse_experiment


class Experiments:
    """The experiments of one installation. Every method may raise a SlamHiveError, in one line.

    Args:
        context: The installation.
    """

    def __init__(self, context: ExperimentContext) -> None:
        self._context = context
        self._tables = AxisTables()
        self._time_left = TimeLeft(context.settings.worker_slots)

    def preview(
        self, source: ExperimentSource, executor: str | None = None, progress: Progress = silent
    ) -> ExperimentPreview:
        """What starting ``source`` would do; nothing is stored, and what would be refused is told with it.

        Raises InvalidInput or NotFound, naming file and line, for a file that makes no plan at all.
        """
        context = self._context
        experiment = parse_experiment(source.text, source.name)
        refusals: list[str] = []
        standing = None
        usable: str | None = None
        try:
            usable = context.executors.choose(executor or experiment.executor)
            record = context.store.read(lambda t: t.experiments.find(experiment.name))
            if record is not None:
                check_same(context, record, experiment, executor)
                standing = self.status(record.name).standing
        except SlamHiveError as error:
            refusals.append(str(error))
        found = preview(context, experiment, usable, standing, progress)
        return replace(found, refusals=(*refusals, *found.refusals))

    def start(
        self, source: ExperimentSource, executor: str | None = None, progress: Progress = silent
    ) -> ExperimentStatus:
        """Store all that ``source`` asks for and queue its runs; ``progress`` is called with runs stored and runs.

        The same file again changes nothing, or completes what was interrupted. ``executor`` wins over the file's.

        Raises:
            InvalidInput: naming file and line; nothing is stored then.
            NotFound: the same, for a name that nothing answers to.
            Conflict: the name belongs to an experiment that states something else, or that was cancelled.
            Unavailable: more disk is needed than there is, or the executor does not answer.
        """
        check_writable(self._context.settings)
        return self.status(start(self._context, source, executor, progress))

    def list(self) -> tuple[ExperimentStatus, ...]:
        """All experiments, the newest first, without the time left."""
        return self._context.store.read(statuses.all_statuses)

    def status(self, name: str) -> ExperimentStatus:
        """How far an experiment is; raises NotFound."""
        return self._context.store.read(lambda t: statuses.status(t, name, self._time_left))

    def source(self, name: str) -> ExperimentSource:
        """The file of an experiment as it was given."""
        record = self._context.store.read(lambda t: t.experiments.get(name))
        return ExperimentSource(record.source, f"experiment {name}")

    def axes(self, name: str) -> dict[str, tuple[Value, ...]]:
        """The axes of an experiment with all their values, in the order of the file."""
        return self._context.store.read(lambda t: self._tables.get(t, t.experiments.get(name)).axes)

    def cells(self, name: str, after: int = 0, limit: int = 50) -> CellPage:
        """The next ``limit`` cells (1 to 1000) after number ``after``, with their runs and figures."""
        return self._context.store.read(lambda t: statuses.cell_page(t, name, after, limit))

    def grid(self, name: str, row_axis: str, column_axis: str) -> Grid:
        """How many runs are queued, running, good, failed and cancelled for each pair of values of two axes."""

        def work(t: Transaction) -> Grid:
            record = t.experiments.get(name)
            counts = t.experiment_counts.by_cell(record.id)
            return self._tables.get(t, record).grid((row_axis, column_axis), counts, name)

        return self._context.store.read(work)

    def report(self, name: str) -> Iterator[Cell]:
        """Every cell in order; few are in memory at a time. Raises NotFound at once."""
        self._context.store.read(lambda t: t.experiments.get(name))
        return statuses.all_cells(self._context, name)

    def run_ids(self, name: str) -> tuple[int, ...]:
        """The ids of all its runs, retries too, in order."""
        return self._context.store.read(lambda t: tuple(t.experiments.run_ids(t.experiments.get(name).id)))

    def unfinished(self, name: str) -> tuple[int, ...]:
        """The ids of its runs that have not ended, or whose evaluation has not, in order."""
        return self._context.store.read(lambda t: tuple(t.experiments.unfinished(t.experiments.get(name).id)))

    def restore_rows(self) -> Iterator[Restored]:
        """Reindex, first part: a row for each experiment folder."""
        check_writable(self._context.settings)
        return restore_rows(self._context)

    def restore_runs(self) -> Iterator[Restored]:
        """Reindex, second part, once run folders are filed: cells, and the runs that no worker has begun."""
        check_writable(self._context.settings)
        return restore_runs(self._context)

    def pause(self, name: str) -> ExperimentStatus:
        """Keep queued runs from being taken; those that a worker has go on. Raises Conflict if all have ended."""
        check_writable(self._context.settings)
        if self.status(name).standing is Standing.FINISHED:
            raise Conflict(f"experiment {name} has finished", "there is nothing to pause")
        return self._put(name, ExperimentState.PAUSED)

    def resume(self, name: str) -> ExperimentStatus:
        """Let queued runs be taken again."""
        return self._put(name, ExperimentState.ACTIVE)

    def cancel(self, name: str) -> ExperimentStatus:
        """Cancel what is queued and ask the workers of active runs to end them; this is for good."""
        return self._put(name, ExperimentState.CANCELLED)

    def retry_failed(self, name: str) -> int:
        """Queue a run in the place of each failed one; how many. At once again, there is none left to do."""
        check_writable(self._context.settings)
        return retry_failed(self._context, name)

    def add_repeats(self, name: str, count: int, progress: Progress = silent) -> ExperimentStatus:
        """Run each cell ``count`` times more with each seed, as if the file had asked for so many at once.

        Raises InvalidInput for a count that is not allowed, Conflict if algorithms or datasets have changed meanwhile.
        """
        check_writable(self._context.settings)
        add_repeats(self._context, name, count, progress)
        return self.status(name)

    def _put(self, name: str, state: ExperimentState) -> ExperimentStatus:
        check_writable(self._context.settings)
        put_state(self._context, name, state)
        return self.status(name)
