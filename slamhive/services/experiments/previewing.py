"""Preview of an experiment: runs, time, disk space, and everything that would keep it from running. Stores nothing."""

from __future__ import annotations

import shutil
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from heapq import nlargest
from itertools import groupby
from statistics import median

from slamhive.base.errors import InvalidInput, SlamHiveError, Unavailable
from slamhive.base.files import size_bytes
from slamhive.base.tree import folder_bytes
from slamhive.documents.experiment import (
    ExperimentPreviewDocument,
    NodesPlanDocument,
    PreviewRowDocument,
    VariantNeedDocument,
)
from slamhive.documents.plain import ConfigurationStanding
from slamhive.domain.configuration import Configuration, Variant
from slamhive.domain.matching import Origin, match_of, shown
from slamhive.domain.placement import DataRuns, makespan_s, place
from slamhive.domain.protocol import Protocol
from slamhive.domain.side_by_side import PlannedMixture, ProtocolUse, mixed_protocols, of_live
from slamhive.experiments.binding import at
from slamhive.experiments.expansion import Expansion, PlannedRun
from slamhive.experiments.experiment import FIRST_LOOK, Experiment
from slamhive.recordings.variants.cache import VariantEntry
from slamhive.services.configurations import unwatchable
from slamhive.services.evaluations import fitting_protocol
from slamhive.services.experiments.context import Costs, ExperimentContext, Progress, guessed_duration_s
from slamhive.services.experiments.views import (
    ASSUMED_DURATION_S,
    assumed_dataset,
    to_fetch,
    unfetched,
)
from slamhive.services.runs import check_disk, check_executor, check_recorded, recorded_topics
from slamhive.services.versions import check_version
from slamhive.store.durations import Pairing
from slamhive.store.records import KnownConfiguration

UNMEASURED_RUN_BYTES = 500_000
"""The assumed size of a run folder if none was measured: log, samples, trajectory and plots of one minute."""

UNMEASURED_BYTES_PER_S = 100_000_000.0
"""The assumed speed of reading a recording for a variant if none was measured: that of a slow disk."""

_MEASURED_RUNS = 20
_ANY_DATASET = ""
Pair = tuple[str, str]
"""Names of algorithm and dataset."""


@dataclass(frozen=True, slots=True)
class DiskSpace:
    """Required and available disk space of an experiment, in bytes.

    With ``variants_elsewhere``, the nodes of a cluster make the variants, so they take no space here.
    """

    variants: tuple[VariantNeedDocument, ...]
    run_bytes: int
    free_bytes: int
    unused_bytes: int
    cache_bytes: int
    variants_elsewhere: bool = False

    @property
    def variant_bytes(self) -> int:
        """The size of all variants that must still be made."""
        return sum(need.needed_bytes for need in self.variants if not need.made)

    @property
    def variant_s(self) -> float:
        """The time for making them one after the other."""
        return sum(need.make_s for need in self.variants if not need.made)


def pair_problems(
    context: ExperimentContext,
    experiment: Experiment,
    expansion: Expansion,
    executor: str,
    missing: Collection[str] = (),
) -> Iterator[SlamHiveError]:
    """Problems of recordings, packages and alignment, each reported once with its place in the file.

    Recordings of the datasets in ``missing`` are not here and not looked at.
    """
    recorded: dict[str, Mapping[str, int] | None] = {}
    packages: set[str] = set()
    limits = list(dict.fromkeys(experiment.every_limit))
    # Parts of cores cannot be compared where each of them would be a whole one.
    for axis in experiment.limit_axes:
        if axis.name == "cpu_cores" and any(float(value) % 1 for value in axis.values):  # type: ignore[arg-type]
            reason = context.executors().get(executor).no_part_of_a_core()
            if reason is not None:
                yield InvalidInput(f"{axis.place}: parts of a core cannot be held: {reason}", "vary whole cores")
    for algorithm, dataset in expansion.pairs:
        if dataset.name in missing:
            recorded[dataset.name] = None
        elif dataset.name not in recorded:
            try:
                recorded[dataset.name] = recorded_topics(dataset)
            except SlamHiveError as error:
                recorded[dataset.name] = None
                yield at(experiment.datasets.place, error)
        topics = recorded[dataset.name]
        try:
            if topics is not None:
                check_recorded(dataset, algorithm, topics)
            if algorithm.package.name not in packages:
                packages.add(algorithm.package.name)
                for asked in limits:
                    check_executor(context.executors().get(executor), algorithm.package, asked)
            check_version(context.store, context.executors().get(executor), algorithm)
            protocol_of_pair(context, experiment, expansion, (algorithm.name, dataset.name))
        except SlamHiveError as error:
            yield at(experiment.datasets.place, error)


def protocol_of_pair(
    context: ExperimentContext, experiment: Experiment, expansion: Expansion, pair: Pair
) -> Protocol | None:
    """The protocol that the experiment requests; None for the default of the sensors."""
    asked = experiment.evaluation.request
    if asked is None:
        return None
    algorithm, dataset = next((a, d) for a, d in expansion.pairs if (a.name, d.name) == pair)
    return fitting_protocol(algorithm, dataset, context.settings, asked)


def planned_mixture(
    context: ExperimentContext, experiment: Experiment, expansion: Expansion, planned: Mapping[Pair, int]
) -> PlannedMixture | None:
    """The protocols of the planned runs if their errors would not be comparable; None if they would be."""
    if not experiment.evaluation.enabled:
        return None
    definitions: dict[str, Protocol] = {}
    uses = []
    for algorithm, dataset in expansion.pairs:
        runs = planned.get((algorithm.name, dataset.name), 0)
        if not runs or (dataset.groundtruth is None and dataset.relations is None):
            continue
        try:
            protocol = fitting_protocol(algorithm, dataset, context.settings, experiment.evaluation.request)
        except SlamHiveError:
            continue  # it is among the refusals
        definitions |= {one.fingerprint: one for one in (protocol, of_live(protocol))}
        kind = None if protocol.trajectory is not None else algorithm.trajectory
        uses.append(ProtocolUse(protocol.fingerprint, protocol.label, kind, runs))
    mixed = mixed_protocols(uses, definitions)
    if mixed is None:
        return None
    common = None if mixed.common is None else definitions[mixed.common.fingerprint]
    return PlannedMixture(mixed, experiment.evaluation.as_in(common, [definitions[use.fingerprint] for use in uses]))


def find_disk_space(
    context: ExperimentContext, expansion: Expansion, executor: str | None, missing: Collection[str] = ()
) -> DiskSpace:
    """The required variants, and the disk space for them and for run folders. ``executor`` is that of the runs.

    Variants of the datasets in ``missing`` are left out, since nobody knows how large their recordings are.
    """
    entries = context.variants().entries()
    made = {entry.key for entry in entries}
    datasets = {dataset.name: dataset for _, dataset in expansion.pairs}
    speeds = _speeds(entries)
    needs: list[VariantNeedDocument] = []
    for name, variants in expansion.variants.items():
        if name in missing:
            continue
        for variant in sorted(variants, key=str):
            plan = context.variants().plan(datasets[name], variant)
            if plan is not None:
                make_s = plan.source_bytes / speeds.get(name, speeds[_ANY_DATASET])
                needs.append(
                    VariantNeedDocument(
                        dataset=name,
                        steps=variant,
                        key=plan.key,
                        needed_bytes=plan.needed_bytes,
                        make_s=make_s,
                        made=plan.key in made,
                    )
                )
    # As much as the latest runs on average.
    numbered = (entry for entry in context.settings.runs_folder.iterdir() if entry.name.isdigit())
    latest = nlargest(_MEASURED_RUNS, numbered, key=lambda entry: int(entry.name))
    sizes = [folder_bytes(folder) for folder in latest]
    run_bytes = sum(sizes) // len(sizes) if sizes else UNMEASURED_RUN_BYTES
    return DiskSpace(
        variants=tuple(needs),
        run_bytes=expansion.size.runs * run_bytes,
        free_bytes=shutil.disk_usage(context.settings.data).free,
        unused_bytes=sum(entry.size_bytes for entry in entries if not entry.in_use),
        cache_bytes=context.settings.variant_cache_bytes,
        variants_elsewhere=executor is not None and context.executors().get(executor).capabilities.makes_variants,
    )


def disk_space_problems(
    context: ExperimentContext, experiment: Experiment, space: DiskSpace
) -> Iterator[SlamHiveError]:
    """Yield what does not fit even if all unused variants are removed; runs on the same variant follow each other."""
    try:
        check_disk(context.settings)
    except Unavailable as error:
        yield error
    here = () if space.variants_elsewhere else space.variants
    largest = max((need.needed_bytes for need in here if not need.made), default=0)
    if largest > space.cache_bytes:
        yield InvalidInput(
            f"{experiment.place}: a variant takes {_mb(largest)}, the cache holds {_mb(space.cache_bytes)}",
            "raise VARIANT_CACHE_BYTES",
        )
    kept = context.settings.min_free_disk_mb * 1_000_000
    needed = largest + space.run_bytes + kept
    if needed > space.free_bytes + space.unused_bytes:
        yield Unavailable(
            f"{experiment.place}: the experiment needs {_mb(needed)} (largest variant {_mb(largest)}, run folders "
            f"{_mb(space.run_bytes)}, kept free {_mb(kept)}), {context.settings.data} has {_mb(space.free_bytes)} free",
            "free some space, or vary less at once",
        )


def warnings(space: DiskSpace) -> Sequence[str]:
    """Warnings about variants that do not fit into the cache together."""
    total = sum(need.needed_bytes for need in space.variants)
    limit = min(space.cache_bytes, space.free_bytes + sum(need.needed_bytes for need in space.variants if need.made))
    if total <= limit or space.variants_elsewhere:
        return ()
    takes = f"its variants take up to {_mb(total)}, there is room for {_mb(limit)}"
    return (f"{takes}: those used longest ago are removed, and made again if a run needs them",)


def _speeds(entries: Sequence[VariantEntry]) -> dict[str, float]:
    """The median speed of making variants, in bytes of the recording per s, for each dataset and for all."""
    known: dict[str, list[float]] = {}
    for entry in entries:
        if entry.bytes_per_s is not None:
            for name in (entry.dataset, _ANY_DATASET):
                known.setdefault(name, []).append(entry.bytes_per_s)
    return {_ANY_DATASET: UNMEASURED_BYTES_PER_S} | {name: median(speeds) for name, speeds in known.items()}


def _mb(count: int) -> str:
    return f"{count / 1e6:,.0f} MB"


NODE_BYTES_PER_S = 100_000_000.0
"""How fast a node gets data: 1 Gbit/s."""

Data = tuple[str, Variant]
"""What a run reads: a variant of a dataset, or the dataset as it is."""


@dataclass(slots=True)
class Workload:
    """The expected time of each run (s), by the data that it reads."""

    by_data: dict[Data, list[float]] = field(default_factory=lambda: defaultdict(list))

    def add(self, configuration: Configuration, run_s: float, runs: int) -> None:
        """Add ``runs`` runs of one configuration."""
        self.by_data[configuration.dataset, configuration.variant] += [run_s] * runs

    @property
    def total_s(self) -> float:
        """Of all runs, one after the other."""
        return sum(map(sum, self.by_data.values()))

    def on_nodes(
        self, nodes: int, data_bytes: Mapping[Data, int], *, recordings_only: bool = False
    ) -> NodesPlanDocument:
        """The plan for so many nodes, each of which executes one run at a time and gets the data of its runs once.

        With ``recordings_only``, nodes make variants, so of each dataset only the recording moves.
        """
        keys = {str(number): data for number, data in enumerate(self.by_data)}
        groups = [
            DataRuns(name, data_bytes[data] / NODE_BYTES_PER_S, tuple(self.by_data[data]))
            for name, data in keys.items()
        ]
        plans = place(groups, nodes)
        moved = [_moved_bytes([keys[name] for name in plan.data], data_bytes, recordings_only) for plan in plans]
        return NodesPlanDocument(
            nodes=nodes,
            used_nodes=sum(bool(plan.runs) for plan in plans),
            time_s=makespan_s(plans),
            moved_bytes=sum(moved),
            node_bytes=max(moved),
            bytes_per_s=NODE_BYTES_PER_S,
        )


def _moved_bytes(data: Sequence[Data], data_bytes: Mapping[Data, int], recordings_only: bool) -> int:
    moved = {dataset: (dataset, variant) for dataset, variant in data}.values() if recordings_only else data
    return sum(data_bytes[entry] for entry in moved)


def bytes_of_data(expansion: Expansion, space: DiskSpace) -> dict[Data, int]:
    """Return the bytes that a node gets for each dataset and variant; of a variant, the most that it can have."""
    moved = () if space.variants_elsewhere else space.variants
    sizes: dict[Data, int] = {(need.dataset, need.steps): need.needed_bytes for need in moved}
    for dataset in {dataset.name: dataset for _, dataset in expansion.pairs}.values():
        recording_bytes = size_bytes(dataset.bag_path) if dataset.bag and dataset.bag_path.exists() else 0
        for variant in ((), *expansion.variants.get(dataset.name, ())):
            sizes.setdefault((dataset.name, variant), recording_bytes)
    return sizes


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
    first_looks: int = 0
    runs: int = 0
    known_cells: int = 0
    known_runs: int = 0
    measured_runs: int = 0
    work: Workload = field(default_factory=Workload)
    rows: list[PreviewRowDocument] = field(default_factory=list)
    first: dict[Pair, Configuration] = field(default_factory=dict)
    """The first configuration of each algorithm on each dataset."""
    planned: Counter[Pair] = field(default_factory=Counter)
    """The number of runs of each algorithm on each dataset."""


def preview(
    context: ExperimentContext,
    experiment: Experiment,
    executor: str | None,
    standing: ConfigurationStanding | None,
    progress: Progress,
    nodes: int | None = None,
) -> ExperimentPreviewDocument:
    """Count, estimate and check; raises as :meth:`ExperimentContext.expand` if the file is not valid.

    ``executor`` is None if none can be used; the caller has added that to the refusals. ``nodes`` of a cluster take the
    place of the slots of this machine.
    """
    here = {dataset.name: dataset for dataset in context.catalogue.datasets()}
    missing = unfetched(map(str, experiment.datasets.values), here, context.catalogue.project_root)
    folder = context.settings.datasets_folder
    expansion = context.expand(
        experiment, {name: assumed_dataset(entry, folder / name) for name, entry in missing.items()}
    )
    wanted = to_fetch(missing)
    space = find_disk_space(context, expansion, executor, missing)
    refusals = [str(error) for error in disk_space_problems(context, experiment, space)]
    if executor is not None:
        refusals += [str(error) for error in pair_problems(context, experiment, expansion, executor, missing)]
    assumed: tuple[str, ...] = ()
    if wanted is not None:
        refusals.append(f"{wanted.words}: {wanted.command}")
        assumption = (
            f"the plan assumes {ASSUMED_DURATION_S:g} s for each recording that is not here, and no space for its "
            "variants; rates, format and calibration are checked once it is here"
        )
        assumed = (assumption,)
    costs, built = context.store.read(lambda t: (Costs.look(t), t.durations.built()))
    between_s = costs.overhead.seconds + (costs.evaluation.seconds if experiment.evaluation.enabled else 0.0)
    builds_s = costs.build.seconds * len({algorithm.package.name for algorithm, _ in expansion.pairs} - built)
    recordings_s = {dataset.name: dataset.duration_s for _, dataset in expansion.pairs}
    means_s = {
        pairing: found.seconds for pairing, found in context.store.read(lambda t: t.durations.of_pairings()).items()
    }
    looks = None if experiment.optimise is None else experiment.optimise.first_look
    clip_s = None if looks is None else looks.seconds
    sums = _Sums()
    for chunk in chunks_of(expansion, CHUNK):
        hashes = [cell[0].content_hash for cell in chunk]
        known = context.store.read(lambda t, hashes=hashes: t.durations.of_configurations(hashes))  # type: ignore[misc]
        for cell in chunk:
            run_s = _add(sums, cell, known.get(cell[0].content_hash), means_s, recordings_s, clip_s)
            sums.work.add(cell[0].configuration, run_s + between_s, len(cell))
        progress(sums.runs, expansion.size.runs)
    cluster = None
    if nodes is not None:
        moved = bytes_of_data(expansion, space)
        cluster = sums.work.on_nodes(nodes, moved, recordings_only=space.variants_elsewhere)
    text = unwatchable(experiment.stop_when, (algorithm for algorithm, _ in expansion.pairs))
    unseen = () if text is None else (f"stop_when: {text}",)
    slots = nodes or context.settings.worker_slots
    runs_s = sums.work.total_s / slots if cluster is None else cluster.time_s
    mixed = planned_mixture(context, experiment, expansion, sums.planned)
    return ExperimentPreviewDocument(
        name=experiment.name,
        description=experiment.description,
        combinations=expansion.size.combinations // (1 if looks is None else 2),
        cells=sums.cells,
        first_looks=sums.first_looks,
        merged=expansion.merged,
        runs=sums.runs,
        axes=dict(expansion.size.axes),
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
        warnings=(*unseen, *assumed, *_defaults(expansion, sums.first, missing), *warnings(space)),
        refusals=tuple(refusals),
        standing=standing,
        repeat_disturbed=experiment.repeat_disturbed,
        cluster=cluster,
        to_fetch=wanted,
        mixed_protocols=None if mixed is None else mixed.sentences,
        mixed=mixed,
    )


def _defaults(expansion: Expansion, first: Mapping[Pair, Configuration], missing: Collection[str]) -> Iterator[str]:
    """Yield one line for each algorithm whose calibration is incomplete, with the defaults of the package it takes."""
    found: dict[tuple[str, str], list[str]] = {}
    for algorithm, dataset in expansion.pairs:
        configuration = first.get((algorithm.name, dataset.name))
        if configuration is None or dataset.name in missing:
            continue
        match = match_of(algorithm, dataset, configuration.parameters, configuration.sensors)
        lacking = [entry for entry in match.bound if entry.origin is Origin.DEFAULT]
        taken = ", ".join(f"{entry.key} {shown(entry.value)} for {entry.source}" for entry in lacking)
        if lacking:
            found.setdefault((algorithm.name, taken), []).append(dataset.name)
    for (name, taken), datasets in found.items():
        yield f"{name}: the calibration of {', '.join(datasets)} lacks what it takes; defaults of the package: {taken}"


def _add(
    sums: _Sums,
    cell: Sequence[PlannedRun],
    known: KnownConfiguration | None,
    means_s: dict[Pairing, float],
    recordings_s: dict[str, float],
    clip_s: float | None,
) -> float:
    """Count the runs of a cell; how long one of them takes (s). ``clip_s``: length of a first look."""
    first = cell[0]
    configuration = first.configuration
    pairing = (
        configuration.algorithm,
        configuration.dataset,
        configuration.playback.mode,
        configuration.playback.rate,
    )
    is_clip = FIRST_LOOK in first.values
    if known is not None and known.measured_runs:
        measured_s = known.duration_s
    else:  # runs on whole recordings do not tell how long one on a clip takes
        measured_s = None if is_clip else means_s.get(pairing)
    if measured_s is not None:
        sums.measured_runs += len(cell)
    else:
        seen_s = recordings_s[configuration.dataset] if clip_s is None or not is_clip else clip_s
        measured_s = guessed_duration_s(pairing, seen_s)
    sums.first_looks += is_clip
    sums.first.setdefault((configuration.algorithm, configuration.dataset), configuration)
    sums.cells += 1
    sums.runs += len(cell)
    sums.planned[configuration.algorithm, configuration.dataset] += len(cell)
    if known is not None:
        sums.known_cells += 1
        sums.known_runs += known.runs
    if len(sums.rows) < ROWS:
        runs = 0 if known is None else known.runs
        sums.rows.append(
            PreviewRowDocument(
                cell=first.cell, name=first.name, values=dict(first.values), known=known is not None, known_runs=runs
            )
        )
    return measured_s
