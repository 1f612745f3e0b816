"""Preview of an experiment: number of runs, time and disk space. Nothing is stored."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby

from slamhive.domain.configuration import Configuration
from slamhive.domain.matching import Origin, match_of, shown
from slamhive.services.configurations import unwatchable
from slamhive.services.experiments.checks import Pair, disk_space_problems, find_disk_space, pair_problems, warnings
from slamhive.services.experiments.context import ExperimentContext, Progress
from slamhive.services.experiments.expected import Costs, guessed_duration_s
from slamhive.services.experiments.planning import Workload, bytes_of_data
from slamhive.services.experiments.views import ExperimentPreview, PreviewRow, Standing
from slamhive.store.durations import Pairing
from slamhive.store.experiment_records import KnownConfiguration
from slamhive.sweep.expand import Expansion, PlannedRun
from slamhive.sweep.experiment import Experiment

ROWS = 20
CHUNK = 1000


def cells_of(expansion: Iterable[PlannedRun]) -> Iterator[list[PlannedRun]]:
    """The planned runs, grouped by cell."""
    for _, runs in groupby(expansion, key=lambda run: run.cell):
        yield list(runs)


def chunks_of(expansion: Iterable[PlannedRun], size: int) -> Iterator[list[list[PlannedRun]]]:
    """Split the cells into chunks of at most ``size`` runs, but at least one cell."""
    chunk: list[list[PlannedRun]] = []
    runs = 0
    for cell in cells_of(expansion):
        if chunk and runs + len(cell) > size:
            yield chunk
            chunk, runs = [], 0
        chunk.append(cell)
        runs += len(cell)
    if chunk:
        yield chunk


@dataclass(slots=True)
class _Sums:
    cells: int = 0
    runs: int = 0
    known_cells: int = 0
    known_runs: int = 0
    measured_runs: int = 0
    work: Workload = field(default_factory=Workload)
    rows: list[PreviewRow] = field(default_factory=list)
    first: dict[Pair, Configuration] = field(default_factory=dict)
    """The first configuration of each algorithm on each dataset."""


def preview(
    context: ExperimentContext,
    experiment: Experiment,
    executor: str | None,
    standing: Standing | None,
    progress: Progress,
    nodes: int | None = None,
) -> ExperimentPreview:
    """Count, estimate and check; raises as :meth:`ExperimentContext.expand` if the file is not valid.

    ``executor`` is None if none can be used; the caller has added that to the refusals. ``nodes`` of a cluster take the
    place of the slots of this machine.
    """
    expansion = context.expand(experiment)
    space = find_disk_space(context, expansion, executor)
    refusals = [str(error) for error in disk_space_problems(context, experiment, space)]
    if executor is not None:
        refusals += [str(error) for error in pair_problems(context, experiment, expansion, executor)]
    between_s, builds_s = _beside_runs_s(context, experiment, expansion)
    sums = _sum_up(context, expansion, progress, between_s)
    cluster = None
    if nodes is not None:
        moved = bytes_of_data(expansion, space)
        cluster = sums.work.on_nodes(nodes, moved, recordings_only=space.variants_elsewhere)
    slots = nodes or context.settings.worker_slots
    runs_s = sums.work.total_s / slots if cluster is None else cluster.time_s
    return ExperimentPreview(
        name=experiment.name,
        description=experiment.description,
        combinations=expansion.size.combinations,
        cells=sums.cells,
        merged=expansion.merged,
        runs=sums.runs,
        axes=expansion.size.axes,
        rows=tuple(sums.rows),
        known_cells=sums.known_cells,
        known_runs=sums.known_runs,
        time_s=runs_s + (builds_s + space.variant_s) / slots,
        variant_time_s=space.variant_s / slots,
        build_time_s=builds_s / slots,
        between_s=between_s,
        measured_runs=sums.measured_runs,
        slots=slots,
        variants=space.variants,
        variant_bytes=space.variant_bytes,
        run_bytes=space.run_bytes,
        free_bytes=space.free_bytes,
        warnings=(*_unseen(experiment, expansion), *_defaults(expansion, sums.first), *warnings(space)),
        refusals=tuple(refusals),
        standing=standing,
        repeat_disturbed=experiment.repeat_disturbed,
        cluster=cluster,
    )


def _beside_runs_s(context: ExperimentContext, experiment: Experiment, expansion: Expansion) -> tuple[float, float]:
    """What is added to each run, and the builds of all packages that were never built here."""
    costs, built = context.store.read(lambda t: (Costs.look(t), t.durations.built()))
    packages = {algorithm.package.name for algorithm, _ in expansion.pairs}
    between_s = costs.overhead.seconds + (costs.evaluation.seconds if experiment.evaluation.enabled else 0.0)
    return between_s, costs.build.seconds * len(packages - built)


def _unseen(experiment: Experiment, expansion: Expansion) -> Iterator[str]:
    text = unwatchable(experiment.stop_when, (algorithm for algorithm, _ in expansion.pairs))
    if text is not None:
        yield f"stop_when: {text}"


def _defaults(expansion: Expansion, first: Mapping[Pair, Configuration]) -> Iterator[str]:
    """What of the calibration is missing, and which default of the package is taken; one line for an algorithm."""
    found: dict[tuple[str, str], list[str]] = {}
    for algorithm, dataset in expansion.pairs:
        configuration = first.get((algorithm.name, dataset.name))
        if configuration is None:
            continue
        match = match_of(algorithm, dataset, configuration.parameters, configuration.sensors)
        missing = [entry for entry in match.bound if entry.origin is Origin.DEFAULT]
        taken = ", ".join(f"{entry.key} {shown(entry.value)} for {entry.source}" for entry in missing)
        if missing:
            found.setdefault((algorithm.name, taken), []).append(dataset.name)
    for (name, taken), datasets in found.items():
        yield f"{name}: the calibration of {', '.join(datasets)} lacks what it takes; defaults of the package: {taken}"


def _sum_up(context: ExperimentContext, expansion: Expansion, progress: Progress, between_s: float) -> _Sums:
    recordings_s = {dataset.name: dataset.duration_s for _, dataset in expansion.pairs}
    means_s = {
        pairing: found.seconds for pairing, found in context.store.read(lambda t: t.durations.of_pairings()).items()
    }
    sums = _Sums()
    for chunk in chunks_of(expansion, CHUNK):
        hashes = [cell[0].content_hash for cell in chunk]
        known = context.store.read(lambda t, hashes=hashes: t.durations.of_configurations(hashes))  # type: ignore[misc]
        for cell in chunk:
            run_s = _add(sums, cell, known.get(cell[0].content_hash), means_s, recordings_s)
            sums.work.add(cell[0].configuration, run_s + between_s, len(cell))
        progress(sums.runs, expansion.size.runs)
    return sums


def _add(
    sums: _Sums,
    cell: Sequence[PlannedRun],
    known: KnownConfiguration | None,
    means_s: dict[Pairing, float],
    recordings_s: dict[str, float],
) -> float:
    """Count the runs of a cell; how long one of them takes (s)."""
    first = cell[0]
    configuration = first.configuration
    pairing = (
        configuration.algorithm,
        configuration.dataset,
        configuration.playback.mode,
        configuration.playback.rate,
    )
    measured_s = known.duration_s if known is not None and known.measured_runs else means_s.get(pairing)
    if measured_s is not None:
        sums.measured_runs += len(cell)
    else:
        measured_s = guessed_duration_s(pairing, recordings_s[configuration.dataset])
    sums.first.setdefault((configuration.algorithm, configuration.dataset), configuration)
    sums.cells += 1
    sums.runs += len(cell)
    if known is not None:
        sums.known_cells += 1
        sums.known_runs += known.runs
    if len(sums.rows) < ROWS:
        runs = 0 if known is None else known.runs
        sums.rows.append(PreviewRow(first.cell, first.name, dict(first.values), known is not None, runs))
    return measured_s
