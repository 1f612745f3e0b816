"""Experiments: preview, start, pause, resume, cancel, retry and report."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from slamhive.base.errors import Conflict, SlamHiveError
from slamhive.documents.plain import ConfigurationStanding, ExperimentStatusDocument
from slamhive.domain.parameters import Value
from slamhive.services.datasets import check_writable
from slamhive.services.experiments import progress as statuses
from slamhive.services.experiments.context import ExperimentContext, Progress, silent
from slamhive.services.experiments.progress import AxisTables, TimeLeft
from slamhive.services.experiments.views import (
    Cell,
    CellPage,
    ExperimentGrid,
    ExperimentSource,
    MetricGrid,
)
from slamhive.store import Transaction
from slamhive.store.records import ExperimentState

if TYPE_CHECKING:
    from slamhive.documents.experiment import ExperimentAnswerDocument, ExperimentPreviewDocument
    from slamhive.domain.accounts import Visibility
    from slamhive.packages.published.experiment import Converted
    from slamhive.services.experiments.progress import AxisTable
    from slamhive.services.experiments.ranking import RankEntries, Ranking
    from slamhive.services.experiments.starting import Restored
    from slamhive.store.records import ExperimentRecord


class ExperimentService:
    """The experiments of one installation.

    Args:
        context: The installation.
    """

    def __init__(self, context: ExperimentContext) -> None:
        self.context = context
        self._tables = AxisTables()
        self._time_left = TimeLeft(context.settings.worker_slots)

    def preview(
        self,
        source: ExperimentSource,
        executor: str | None = None,
        progress: Progress = silent,
        nodes: int | None = None,
    ) -> ExperimentPreviewDocument:
        """Preview the start of ``source``, including the reasons that would prevent it; nothing is stored.

        With ``nodes``, the time is that on so many nodes of a cluster.

        Raises InvalidInput or NotFound, naming file and line, if the file is not valid.
        """
        from slamhive.experiments.file import parse_experiment  # noqa: PLC0415
        from slamhive.services.experiments.previewing import preview  # noqa: PLC0415 - lists and reports need neither
        from slamhive.services.experiments.starting import check_question, check_same  # noqa: PLC0415

        context = self.context
        source = context.with_datasets(source)
        experiment = parse_experiment(source.text, source.name)
        refusals: list[str] = []
        standing = None
        usable: str | None = None
        try:
            usable = context.executors().choose(executor or experiment.executor)
            context.store.read(lambda t: t.experiments.check_free(experiment.name))
            record = context.store.read(lambda t: t.experiments.find(experiment.name))
            if record is not None:
                check_same(context, record, experiment, executor)
                standing = self.status(record.name).state
        except SlamHiveError as error:
            refusals.append(str(error))
        found = preview(context, experiment, usable, standing, progress, nodes)
        if experiment.plan is not None:
            chooses = (
                "the experiment chooses itself which of these run, and how often, within its budget of "
                f"{experiment.plan.budget.words}"
            )
            found = found.model_copy(update={"warnings": (*found.warnings, chooses)})
            try:
                check_question(context, experiment, context.expand(experiment))
            except SlamHiveError as error:
                refusals.append(str(error))
        return found.model_copy(update={"refusals": (*refusals, *found.refusals)})

    def convert(self, source: ExperimentSource, meanings: Mapping[str, str]) -> tuple[Converted, ...]:
        """Combinations of the published SLAM Hive as experiment files; raises as :func:`convert_published`."""
        from slamhive.services.experiments.converting import convert_published  # noqa: PLC0415

        return convert_published(self.context.catalogue, source, meanings)

    def start(
        self,
        source: ExperimentSource,
        executor: str | None = None,
        progress: Progress = silent,
        visibility: Visibility | None = None,
    ) -> ExperimentStatusDocument:
        """Store the experiment and queue its runs; ``progress`` is called with the runs stored and their total.

        Starting the same file again completes an interrupted start, or changes nothing. ``executor`` overrides that of
        the file. ``visibility`` says who may see the experiment and its runs from the beginning.

        Raises:
            InvalidInput: the file is not valid; names file and line, and nothing is stored.
            NotFound: the same, for an unknown name.
            Conflict: another experiment has this name, or it was cancelled.
            Unavailable: the disk space is not sufficient, or the executor does not answer.
        """
        from slamhive.services.experiments.starting import start  # noqa: PLC0415

        check_writable(self.context.settings)
        return self.status(start(self.context, source, executor, progress, visibility))

    def list(self) -> tuple[ExperimentStatusDocument, ...]:
        """All experiments, the newest first, without the time left."""
        return self.context.store.read(statuses.all_statuses)

    def is_failing(self, found: ExperimentStatusDocument) -> bool:
        """Tell if the latest runs of an experiment that goes on have all failed (NOTIFY_FAILURES)."""
        wanted = self.context.settings.notify_failures
        return self.context.store.read(lambda t: statuses.is_failing(t, found, wanted))

    def status(self, name: str) -> ExperimentStatusDocument:
        """The progress of an experiment; raises NotFound."""
        return self.context.store.read(lambda t: statuses.status(t, name, self._time_left))

    def source(self, name: str) -> ExperimentSource:
        """The original file of an experiment."""
        record = self.context.store.read(lambda t: t.experiments.get(name))
        return ExperimentSource(record.source, f"experiment {name}")

    def axes(self, name: str) -> dict[str, tuple[Value, ...]]:
        """The axes of an experiment with all values, in the order of the file."""
        return self.context.store.read(lambda t: self._tables.get(t, t.experiments.get(name)).axes)

    def cells(self, name: str, after: int = 0, limit: int = 50) -> CellPage:
        """The next ``limit`` cells (1 to 1000) after number ``after``, with their runs and metrics."""
        return self.context.store.read(lambda t: statuses.cell_page(t, name, after, limit))

    def grid(self, name: str, row_axis: str, column_axis: str) -> ExperimentGrid:
        """The number of runs in each phase, for each pair of values of two axes."""

        def work(t: Transaction) -> ExperimentGrid:
            record = t.experiments.get(name)
            counts = t.experiment_counts.by_cell(record.id)
            return self._tables.get(t, record).grid((row_axis, column_axis), counts, name)

        return self.context.store.read(work)

    def metric_grid(self, name: str, row_axis: str, column_axis: str, metric: str) -> MetricGrid:
        """The mean of a metric over the good runs, for each pair of values of two axes."""

        def work(t: Transaction) -> MetricGrid:
            record = t.experiments.get(name)
            samples = t.experiment_values.samples(record.id, metric)
            return self._tables.get(t, record).means((row_axis, column_axis), samples, name)

        return self.context.store.read(work)

    def rankings(self, name: str, *, by_algorithm: bool = False) -> tuple[Ranking, ...]:
        """The configurations in order, the best first, for each dataset on which a run has ended.

        With ``by_algorithm``, each algorithm has one place, that of its first configuration.
        """
        from slamhive.services.experiments.ranking import rankings  # noqa: PLC0415 - lists and reports need none

        return self.context.store.read(lambda t: rankings(t, *self._ranked(t, name), by_algorithm=by_algorithm))

    def answer(self, name: str) -> ExperimentAnswerDocument:
        """The answer of the experiment so far, in a sentence, and the repeats that would settle it."""
        from slamhive.services.experiments.answer import answer  # noqa: PLC0415 - lists and reports need none

        return self.context.store.read(lambda t: answer(*self._ranked(t, name)))

    def answer_and_rankings(
        self, name: str, *, by_algorithm: bool
    ) -> tuple[ExperimentAnswerDocument, tuple[Ranking, ...]]:
        """The same as :meth:`answer` and :meth:`rankings`, from one reading of the runs."""
        from slamhive.services.experiments.answer import answer  # noqa: PLC0415 - lists and reports need none
        from slamhive.services.experiments.ranking import rankings  # noqa: PLC0415

        def work(t: Transaction) -> tuple[ExperimentAnswerDocument, tuple[Ranking, ...]]:
            ranked = self._ranked(t, name)
            return answer(*ranked), rankings(t, *ranked, by_algorithm=by_algorithm)

        return self.context.store.read(work)

    def _ranked(self, t: Transaction, name: str) -> tuple[ExperimentRecord, AxisTable, dict[str, RankEntries]]:
        from slamhive.services.experiments.ranking import entries_by_dataset  # noqa: PLC0415 - as above

        record = t.experiments.get(name)
        table = self._tables.get(t, record)
        return record, table, entries_by_dataset(t, record, table)

    def report(self, name: str) -> Iterator[Cell]:
        """All cells in order, read in pages to save memory. Raises NotFound at once."""
        self.context.store.read(lambda t: t.experiments.get(name))
        return statuses.all_cells(self.context, name)

    def run_ids(self, name: str) -> tuple[int, ...]:
        """The ids of all its runs, including retries, in order."""
        return self.context.store.read(lambda t: tuple(t.experiments.run_ids(t.experiments.get(name).id)))

    def unfinished(self, name: str) -> tuple[int, ...]:
        """The ids of its runs that have not ended or wait for evaluation, in order."""
        return self.context.store.read(lambda t: tuple(t.experiments.unfinished(t.experiments.get(name).id)))

    def restore_rows(self) -> Iterator[Restored]:
        """First part of reindexing: a row for each experiment folder."""
        from slamhive.services.experiments.starting import restore_rows  # noqa: PLC0415

        check_writable(self.context.settings)
        return restore_rows(self.context)

    def restore_runs(self) -> Iterator[Restored]:
        """Second part of reindexing, after the run folders are filed: cells, and runs that no worker has started."""
        from slamhive.services.experiments.starting import restore_runs  # noqa: PLC0415

        check_writable(self.context.settings)
        return restore_runs(self.context)

    def pause(self, name: str) -> ExperimentStatusDocument:
        """Hold queued runs; active runs continue. Raises Conflict if all runs have ended."""
        check_writable(self.context.settings)
        if self.status(name).state is ConfigurationStanding.FINISHED:
            raise Conflict(f"experiment {name} has finished", "there is nothing to pause")
        return self._put(name, ExperimentState.PAUSED)

    def resume(self, name: str) -> ExperimentStatusDocument:
        """Release the held runs."""
        return self._put(name, ExperimentState.ACTIVE)

    def cancel(self, name: str) -> ExperimentStatusDocument:
        """Cancel all queued and active runs. This cannot be undone."""
        return self._put(name, ExperimentState.CANCELLED)

    def retry_failed(self, name: str) -> int:
        """Queue a new run for each failed one; returns their number. A second call finds none left to retry."""
        from slamhive.services.experiments.starting import retry_failed  # noqa: PLC0415

        check_writable(self.context.settings)
        return retry_failed(self.context, name)

    def add_repeats(self, name: str, count: int, progress: Progress = silent) -> ExperimentStatusDocument:
        """Add ``count`` repeats to each cell and seed, as if the file had requested them from the start.

        Raises InvalidInput for a count that is not allowed, Conflict if algorithms or datasets have changed.
        """
        from slamhive.services.experiments.starting import add_repeats  # noqa: PLC0415

        check_writable(self.context.settings)
        add_repeats(self.context, name, count, progress)
        return self.status(name)

    def ask_for_runs(self, name: str, more: Mapping[int, int], known: int) -> Sequence[int]:
        """Queue more runs of an experiment that chooses them; see the function of this name in ``starting``."""
        from slamhive.services.experiments.starting import ask_for_runs  # noqa: PLC0415

        check_writable(self.context.settings)
        return ask_for_runs(self.context, name, more, known)

    def conclude(self, name: str, words: str) -> None:
        """Store the conclusion of an experiment that chooses its runs."""
        from slamhive.services.experiments.starting import conclude  # noqa: PLC0415

        check_writable(self.context.settings)
        conclude(self.context, name, words)

    def _put(self, name: str, state: ExperimentState) -> ExperimentStatusDocument:
        from slamhive.services.experiments.starting import put_state  # noqa: PLC0415

        check_writable(self.context.settings)
        put_state(self.context, name, state)
        return self.status(name)
