"""Checks before an experiment is stored: everything that would keep it from running."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from heapq import nlargest
from statistics import median

from slamhive.bags.variants.cache import VariantEntry
from slamhive.domain.protocol import Protocol
from slamhive.errors import InvalidInput, SlamHiveError, Unavailable
from slamhive.services.evaluations import protocol_for
from slamhive.services.experiments.context import ExperimentContext
from slamhive.services.experiments.views import VariantNeed
from slamhive.services.runs import RunLimits, check_disk, check_executor, check_recorded, recorded_topics
from slamhive.services.versions import check_version
from slamhive.sweep.binding import at
from slamhive.sweep.expand import Expansion
from slamhive.sweep.experiment import Experiment
from slamhive.tree import folder_bytes

UNMEASURED_RUN_BYTES = 500_000
"""The assumed size of a run folder if none was measured: log, samples, trajectory and plots of one minute."""

UNMEASURED_BYTES_PER_S = 100_000_000.0
"""Of a recording, read while a variant of it is made, as long as none was: what a slow disk takes up."""

_MEASURED_RUNS = 20
_ANY_DATASET = ""
Pair = tuple[str, str]
"""Names of algorithm and dataset."""


@dataclass(frozen=True, slots=True)
class DiskSpace:
    """Required and available disk space of an experiment, in bytes.

    With ``variants_elsewhere``, the nodes of a cluster make the variants, so they take no space here.
    """

    variants: tuple[VariantNeed, ...]
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
    context: ExperimentContext, experiment: Experiment, expansion: Expansion, executor: str
) -> Iterator[SlamHiveError]:
    """Problems of recordings, packages and alignment, each reported once with its place in the file."""
    recorded: dict[str, Mapping[str, int] | None] = {}
    packages: set[str] = set()
    asked = RunLimits(experiment.limits.cpu_cores, experiment.limits.memory_mb)
    for algorithm, dataset in expansion.pairs:
        if dataset.name not in recorded:
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
                check_executor(context.executors.get(executor), algorithm.package, asked)
            check_version(context.store, context.executors.get(executor), algorithm)
            protocol_of_pair(context, experiment, expansion, (algorithm.name, dataset.name))
        except SlamHiveError as error:
            yield at(experiment.datasets.place, error)


def protocol_of_pair(
    context: ExperimentContext, experiment: Experiment, expansion: Expansion, pair: Pair
) -> Protocol | None:
    """The protocol that the experiment requests; None for the default of the sensors."""
    if experiment.evaluation.alignment is None:
        return None
    algorithm, dataset = next((a, d) for a, d in expansion.pairs if (a.name, d.name) == pair)
    return protocol_for(algorithm, dataset, context.settings, experiment.evaluation.alignment)


def find_disk_space(context: ExperimentContext, expansion: Expansion, executor: str | None) -> DiskSpace:
    """The required variants, and the disk space for them and for run folders. ``executor`` is that of the runs."""
    entries = context.variants.entries()
    made = {entry.key for entry in entries}
    datasets = {dataset.name: dataset for _, dataset in expansion.pairs}
    speeds = _speeds(entries)
    needs: list[VariantNeed] = []
    for name, variants in expansion.variants.items():
        for variant in sorted(variants, key=str):
            plan = context.variants.plan(datasets[name], variant)
            if plan is not None:
                make_s = plan.source_bytes / speeds.get(name, speeds[_ANY_DATASET])
                needs.append(VariantNeed(name, variant, plan.key, plan.needed_bytes, make_s, plan.key in made))
    return DiskSpace(
        variants=tuple(needs),
        run_bytes=expansion.size.runs * _bytes_of_a_run(context),
        free_bytes=shutil.disk_usage(context.settings.data).free,
        unused_bytes=sum(entry.size_bytes for entry in entries if not entry.in_use),
        cache_bytes=context.settings.variant_cache_bytes,
        variants_elsewhere=executor is not None and context.executors.get(executor).capabilities.makes_variants,
    )


def disk_space_problems(
    context: ExperimentContext, experiment: Experiment, space: DiskSpace
) -> Iterator[SlamHiveError]:
    """What does not fit even if all unused variants are removed; runs on the same variant follow each other."""
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


def _bytes_of_a_run(context: ExperimentContext) -> int:
    """The mean size of the latest run folders, in bytes."""
    numbered = (entry for entry in context.settings.runs_folder.iterdir() if entry.name.isdigit())
    latest = nlargest(_MEASURED_RUNS, numbered, key=lambda entry: int(entry.name))
    sizes = [folder_bytes(folder) for folder in latest]
    return sum(sizes) // len(sizes) if sizes else UNMEASURED_RUN_BYTES


def _mb(count: int) -> str:
    return f"{count / 1e6:,.0f} MB"
