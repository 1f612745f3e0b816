"""What limits the answer of a gate: few runs, other machines, disturbed runs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain

from slamhive.domain.numbers import plural
from slamhive.schema.gate import MeasuredRun
from slamhive.services.gates.candidates import Pair

_MEASURED = "CPU, memory and latency"


def remarks(pairs: Sequence[Pair], significance: float) -> Iterator[str]:
    """One sentence each."""
    for pair in pairs:
        counts = len(pair.held.runs), len(pair.runs)
        if min(counts) < 2 or 1 / math.comb(sum(counts), counts[0]) > significance:
            yield (
                f"{pair.words} has too few runs to decide on its own: {plural(counts[1], 'run')} against "
                f"{counts[0]} of the baseline."
            )
    baseline = [*chain.from_iterable(pair.held.runs for pair in pairs)]
    candidates = [*chain.from_iterable(pair.measured for pair in pairs)]
    yield from _machines(baseline, candidates)
    disturbed = [sum(run.disturbed is True for run in runs) for runs in (baseline, candidates)]
    if any(disturbed):
        yield (
            f"{plural(disturbed[1], 'run')}, and {disturbed[0]} of the baseline, ran on a disturbed machine: "
            f"{_MEASURED} may be wrong."
        )


def _machines(baseline: Sequence[MeasuredRun], candidates: Sequence[MeasuredRun]) -> Iterator[str]:
    """Where the good runs of the two were not measured in the same way."""
    baseline, candidates = ([run for run in runs if run.failed is None] for runs in (baseline, candidates))
    models = [_texts(run.cpu_model for run in runs) for runs in (baseline, candidates)]
    if all(models) and models[0] != models[1]:
        yield f"{_MEASURED} are of different processors: {', '.join(models[1])}; the baseline {', '.join(models[0])}."
    executors = [_texts(run.executor for run in runs) for runs in (baseline, candidates)]
    if all(executors) and executors[0] != executors[1]:
        yield f"The executors differ: {', '.join(executors[1])}; the baseline {', '.join(executors[0])}."
    limits = [{(run.limits.cpu_cores, run.limits.memory_mb) for run in runs} for runs in (baseline, candidates)]
    if all(limits) and limits[0] != limits[1]:
        yield f"The runs had other limits of CPU or memory than the baseline, so {_MEASURED} may differ."


def _texts(values: Iterable[str | None]) -> list[str]:
    return sorted({value for value in values if value is not None})
