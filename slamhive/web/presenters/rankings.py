"""The ranking of an experiment on its page: for each dataset a table whose rows draw the runs of a configuration."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean

from slamhive.analysis.chart import algorithm_colours
from slamhive.documents.plain import ExperimentStatusDocument
from slamhive.domain.metrics import CATALOGUE, Metric
from slamhive.domain.parameters import Value
from slamhive.domain.side_by_side import short_names
from slamhive.domain.trust import TrustLevel
from slamhive.domain.verdict import Outcome
from slamhive.services.experiments import RANKED_BY, RankedCell, Ranking
from slamhive.services.hive import Hive
from slamhive.store import RunRecord
from slamhive.web.formatting import (
    DASH,
    TableCell,
    display_unit,
    mean_text,
    metric_cell,
    plural,
    significant,
    thousands,
    value_text,
)
from slamhive.web.presenters.experiments import selection, varying
from slamhive.web.small_plots import StripAxis, axis_of, failure_places

LARGEST = 5000
"""An experiment with more configurations has no ranking: reading their runs takes too long for a page."""
BESIDE = ("cpu.mean", "ram.max")
"""Metrics beside the one that the ranking is by."""
_LEVELS = (TrustLevel.LOW, TrustLevel.LIMITED)


@dataclass(frozen=True, slots=True)
class Mark:
    """One run in a strip: its place in percent, and words on hover."""

    run_id: int
    place: float
    words: str


@dataclass(frozen=True, slots=True)
class RankRow:
    """A configuration. ``trust`` is the level, empty if it is high or not known, then text and words on hover."""

    place: str
    name: str
    configuration_id: int
    colour: str
    dots: tuple[Mark, ...]
    crosses: tuple[Mark, ...]
    mean: TableCell
    good: str
    failed: int
    beside: tuple[TableCell, ...]
    trust: tuple[str, str, str]
    selects: str
    words: str


@dataclass(frozen=True, slots=True)
class RankingView:
    """The table of one dataset. ``rows`` contain None where configurations are left out; ``notes`` say what is."""

    dataset: str
    protocol: str
    axis: StripAxis | None
    ticks: tuple[tuple[float, str], ...]
    has_failures: bool
    rows: tuple[RankRow | None, ...]
    notes: tuple[str, ...]


def title(status: ExperimentStatusDocument) -> str:
    """The heading: a ranking is preliminary until all runs have ended."""
    if status.ended == status.runs:
        return "Ranking"
    return f"Preliminary: {thousands(status.ended)} of {plural(status.runs, 'run')} have ended"


def columns() -> list[tuple[Metric, str]]:
    """The metrics of the table with their units, that of the ranking first."""
    return [(CATALOGUE[key], display_unit(CATALOGUE[key]).unit) for key in (RANKED_BY, *BESIDE)]


def naming_axes(axes: Mapping[str, int]) -> list[str]:
    """The axes that name configurations, from {axis: number of values}."""
    return [axis for axis in axes if axis in {"algorithm", "dataset", *varying(axes)}]


def of_experiment(
    services: Hive, status: ExperimentStatusDocument, axes: Sequence[str], *, by_algorithm: bool
) -> list[RankingView]:
    """The tables of an experiment; none while no run has ended, or if it is too large."""
    if status.cells > LARGEST:
        return []
    return views(services.experiments.rankings(status.name, by_algorithm=by_algorithm), axes)


def views(found: Iterable[Ranking], axes: Sequence[str]) -> list[RankingView]:
    """The tables. ``axes`` are those that name configurations. The algorithms have the first colours of the palette."""
    rankings = list(found)
    names = {str(ranked.cell.values["algorithm"]) for ranking in rankings for ranked in _shown(ranking)}
    colours = algorithm_colours(names, names)
    return [_view(ranking, [axis for axis in axes if axis != "dataset"], colours) for ranking in rankings]


def configuration_name(values: Mapping[str, Value], axes: Sequence[str]) -> str:
    """``orb-slam3-mono, image_rate 10``: the values on these axes, without axes that do not apply."""
    known = [(axis, values[axis]) for axis in axes if values.get(axis) is not None]
    return ", ".join(
        value_text(value) if axis == "algorithm" else f"{axis} {value_text(value)}" for axis, value in known
    )


def _shown(ranking: Ranking) -> tuple[RankedCell, ...]:
    return (*ranking.best, *ranking.worst)


def _view(ranking: Ranking, axes: Sequence[str], colours: Mapping[str, str]) -> RankingView:
    factor = display_unit(CATALOGUE[RANKED_BY]).factor
    shown = _shown(ranking)
    values = [value * factor for ranked in shown for _, value in _values(ranked, ranking)]
    failures = any(_failed(ranked) for ranked in shown)
    axis = axis_of(values, failures=failures)
    best, worst = (
        [_row(ranked, ranking, axis, axes, colours) for ranked in part] for part in (ranking.best, ranking.worst)
    )
    return RankingView(
        dataset=ranking.dataset,
        protocol="" if ranking.protocol is None else ranking.protocol.label,
        axis=axis,
        ticks=() if axis is None else tuple((place, f"{value:.6g}") for place, value in axis.ticks),
        has_failures=failures,
        rows=(*best, *([None] if ranking.between else []), *worst),
        notes=tuple(_notes(ranking)),
    )


def _notes(ranking: Ranking) -> Iterable[str]:
    if ranking.between:
        yield f"{plural(ranking.between, 'configuration')} between the best and the worst are not shown"
    if ranking.waiting:
        yield f"of {plural(ranking.waiting, 'configuration')}, no run has been evaluated or has failed yet"
    if ranking.other_runs:
        yield f"{plural(ranking.other_runs, 'good run')} of another protocol or trajectory, so nothing has a place"
    if ranking.without:
        yield f"{plural(ranking.without, 'configuration')} evaluated without {CATALOGUE[RANKED_BY].label}"


def _row(
    ranked: RankedCell, ranking: Ranking, axis: StripAxis | None, axes: Sequence[str], colours: Mapping[str, str]
) -> RankRow:
    metric = CATALOGUE[RANKED_BY]
    shown = display_unit(metric)
    values = _values(ranked, ranking)
    failed = _failed(ranked)
    good = [run for run, _ in values]
    counted = ranked.good or ranked.other
    n = 0 if counted is None else counted.n
    under = ""
    if ranked.good is None and ranked.other is not None and ranking.protocol is not None:
        under = f" under {short_names([ranked.other.protocol.label, ranking.protocol.label])[0]}"
    name = configuration_name(ranked.cell.values, axes) or ranked.cell.name
    texts = [significant(value * shown.factor) for _, value in values]
    drawn = f"{shown.unit}: {', '.join(texts)}" if texts else "no good run of this protocol" if under else "no good run"
    beside = []
    for key in BESIDE:
        measured = [run.metrics[key] for run in good if run.metrics and key in run.metrics]
        beside.append(metric_cell(CATALOGUE[key], fmean(measured) if measured else None))
    return RankRow(
        place=DASH if ranked.place is None else str(ranked.place),
        name=name,
        configuration_id=ranked.cell.configuration_id,
        colour=colours[str(ranked.cell.values["algorithm"])],
        dots=()
        if axis is None
        else tuple(
            Mark(run.id, axis.place(value * shown.factor), f"run {run.id}: {text} {shown.unit}")
            for (run, value), text in zip(values, texts, strict=True)
        ),
        crosses=tuple(
            Mark(
                run.id, place, f"run {run.id}: {run.outcome_words}. {run.verdict.words if run.verdict else ''}".strip()
            )
            for run, place in zip(failed, failure_places(len(failed)), strict=False)
        ),
        mean=_mean(metric, ranked),
        good=f"{thousands(n)} of {thousands(ranked.total)}{under}",
        failed=ranked.failed,
        beside=tuple(beside),
        trust=_trust(good),
        selects=selection([run.id for run in ranked.runs]),
        words=f"ATE RMSE in {drawn}",
    )


def _values(ranked: RankedCell, ranking: Ranking) -> list[tuple[RunRecord, float]]:
    """The good runs under the protocol of the ranking."""
    return [
        (run, run.metrics[RANKED_BY])
        for run in ranked.runs
        if run.metrics is not None
        and RANKED_BY in run.metrics
        and run.protocol is not None
        and ranking.protocol is not None
        and run.protocol.fingerprint == ranking.protocol.fingerprint
        and (not ranking.other_runs or run.protocol.label == ranking.protocol.label)
        and run.verdict is not None
        and not run.verdict.failed
    ]


def _failed(ranked: RankedCell) -> list[RunRecord]:
    return [run for run in ranked.runs if run.outcome is Outcome.FAILED]


def _mean(metric: Metric, ranked: RankedCell) -> TableCell:
    if ranked.good is None:
        return metric_cell(metric, None)
    shown = display_unit(metric)
    std = None if ranked.good.n < 2 else ranked.good.variance**0.5 * shown.factor
    exact = f"mean of {plural(ranked.good.n, 'good run')} {shown.unit}".strip()
    return TableCell(mean_text(ranked.good.mean * shown.factor, std), exact)


def _trust(runs: Sequence[RunRecord]) -> tuple[str, str, str]:
    """The lowest level among good runs, how many have it, and why."""
    found = [trust for run in runs if (trust := run.trust) is not None]
    levels = Counter(trust.level for trust in found)
    level = next((level for level in _LEVELS if levels[level]), None)
    if level is None:
        known = levels[TrustLevel.HIGH]
        why = "; ".join(dict.fromkeys(trust.words for trust in found if trust.level is None and trust.words))
        return ("", "high", "of all good runs") if known and known == len(runs) else ("", DASH, why or "not known")
    reasons = dict.fromkeys(trust.words for trust in found if trust.level is level)
    doubt = next(trust.doubt for trust in found if trust.level is level)
    return level.value, f"{doubt}, {levels[level]} of {plural(len(runs), 'run')}", " / ".join(list(reasons)[:3])
