"""Comparison of a few runs: their settings, their metrics under one protocol, and the analysis that draws them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from statistics import fmean, variance
from typing import TYPE_CHECKING, Any

from slamhive.base import strict_yaml
from slamhive.base.bounds import whole_number
from slamhive.base.errors import InvalidInput, NotFound
from slamhive.documents.catalogue import MatchDocument
from slamhive.documents.limits import NO_SLOW_DOWN
from slamhive.documents.protocol import (
    ComparedColumn,
    ComparedMetric,
    ComparedProtocol,
    ComparedValue,
    ComparisonDocument,
    shown_digits,
)
from slamhive.domain.algorithm import IMPORTED
from slamhive.domain.metrics import CATALOGUE, Direction, Metric, with_unknown
from slamhive.domain.names import plural
from slamhive.domain.protocol import TrajectoryKind, with_trajectory
from slamhive.domain.run import RunState
from slamhive.domain.side_by_side import MixedProtocols
from slamhive.domain.trust import TrustLevel
from slamhive.domain.verdict import ERROR, Outcome, judge
from slamhive.run_folder.folder import RunFolder
from slamhive.store import Store
from slamhive.store.records import EvaluationState, ProtocolLabel, RunRecord, verdict_kind
from slamhive.store.transaction import Transaction

if TYPE_CHECKING:
    from slamhive.analysis.report import Plot
    from slamhive.services.analysis import AnalysisService

# Better metrics are marked if the runs differ in nothing that explains them.


class MarkedPart(StrEnum):
    """A part of the metrics, as sentences name it."""

    ALL = "nothing"
    ACCURACY = "no accuracy"
    MEASURED = "no CPU, memory or time"


@dataclass(frozen=True, slots=True)
class Unmarked:
    """Why no metric of a part is marked."""

    part: MarkedPart
    why: str

    @property
    def words(self) -> str:
        """The same as the end of a line: ``nothing is marked as better: the runs are of 2 datasets``."""
        return f"{self.part} is marked as better: {self.why}"

    def holds_for(self, metric: Metric) -> bool:
        """Tell if ``metric`` belongs to the part."""
        return self.part is MarkedPart.ALL or metric.needs_protocol is (self.part is MarkedPart.ACCURACY)


def unmarked_parts(runs: Sequence[RunRecord], *, mixed_trajectories: bool) -> tuple[Unmarked, ...]:
    """The parts of the metrics in which the runs cannot be compared.

    Args:
        runs: All runs of the comparison.
        mixed_trajectories: Whether live, final and keyframe trajectories were judged.
    """
    datasets = {run.dataset for run in runs}
    if len(datasets) > 1:
        return (Unmarked(MarkedPart.ALL, f"the runs are of {len(datasets)} datasets"),)
    models = {run.host.cpu_model for run in runs if run.host is not None}
    accuracy = (Unmarked(MarkedPart.ACCURACY, "kinds of trajectories are mixed"),) if mixed_trajectories else ()
    measured = (Unmarked(MarkedPart.MEASURED, f"the runs are of {plural(len(models), 'CPU model')}"),)
    return accuracy + (measured if len(models) > 1 else ())


FEWEST_RUNS, MOST_RUNS = 2, 20
_LARGEST_ID = 2**53 - 1
_REMEDY = f"name {FEWEST_RUNS} to {MOST_RUNS} runs, for example 3,5,8"


@dataclass(frozen=True, slots=True)
class RunColumn:
    """One column: a run, or the runs of a configuration. ``failed`` are the members that count as failed."""

    runs: tuple[RunRecord, ...]
    failed: tuple[int, ...]

    @property
    def run_ids(self) -> tuple[int, ...]:
        """The numbers of its runs."""
        return tuple(run.id for run in self.runs)

    @property
    def doubtful(self) -> tuple[int, ...]:
        """The numbers of those of its runs that cannot be trusted fully."""
        return tuple(run.id for run in self.runs if run.trust is not None and run.trust.reasons)

    @property
    def can_be_better(self) -> bool:
        """True if one of its runs neither failed nor has low trust: its values are those of the algorithm."""
        low = {run.id for run in self.runs if run.trust is not None and run.trust.level is TrustLevel.LOW}
        return any(run_id not in low and run_id not in self.failed for run_id in self.run_ids)


@dataclass(frozen=True, slots=True)
class SettingLine:
    """One setting or parameter: a text for each column, None where the runs do not have it."""

    key: str
    texts: tuple[str | None, ...]

    @property
    def differs(self) -> bool:
        """True if the columns have different values."""
        return len(set(self.texts)) > 1


@dataclass(frozen=True, slots=True)
class MetricLine:
    """One metric: a value for each column, None where it is missing. ``best`` is the column to mark, None for none."""

    metric: Metric
    figures: tuple[ComparedValue | None, ...]
    best: int | None

    @property
    def differs(self) -> bool:
        """True if the columns have different values, in the digits that are shown."""
        return len({None if figure is None else figure.shown for figure in self.figures}) > 1

    def document(self, columns: Sequence[str]) -> ComparedMetric:
        """The line as JSON has it; ``columns`` are the names of the columns."""
        return ComparedMetric.of(
            self,
            unit=self.metric.unit,
            better=self.metric.direction,
            best=None if self.best is None else columns[self.best],
            values=dict(zip(columns, self.figures, strict=True)),
        )


@dataclass(frozen=True, slots=True)
class RunComparison:
    """Runs side by side under one protocol; ``protocol`` is None if none of them is evaluated.

    ``unmarked`` says in which metrics the runs are not comparable, so that none is marked as better. Differences count
    from the column at the place ``baseline``. ``mixed`` is there if runs lack the protocol and have another one, or if
    live and final trajectories were judged. ``sentences`` say how each group of repeats stands to the baseline; none
    for single runs.
    """

    columns: tuple[RunColumn, ...]
    grouped: bool
    protocols: tuple[ComparedProtocol, ...]
    protocol: ComparedProtocol | None
    settings: tuple[SettingLine, ...]
    metrics: tuple[MetricLine, ...]
    unmarked: tuple[Unmarked, ...]
    baseline: int = 0
    mixed: MixedProtocols | None = None
    sentences: tuple[str, ...] = ()

    @property
    def runs(self) -> tuple[RunRecord, ...]:
        """All runs, in the order of the columns."""
        return tuple(run for column in self.columns for run in column.runs)

    @property
    def mixed_trajectories(self) -> dict[str, tuple[int, ...]]:
        """The runs by the kind of the trajectory that was judged, if there are several kinds."""
        return mixed_trajectories(self.runs, self.protocol)

    @property
    def marks_nothing(self) -> bool:
        """True if no metric at all is marked as better."""
        return any(entry.part is MarkedPart.ALL for entry in self.unmarked)

    @property
    def single_runs(self) -> bool:
        """True if each column is one run, so that nobody knows how much repeats would differ."""
        return all(len(column.runs) == 1 for column in self.columns)

    @property
    def address(self) -> str:
        """The path of its page."""
        group = "&group=configuration" if self.grouped else ""
        protocol = "" if self.protocol is None else f"&protocol={self.protocol.fingerprint}"
        return f"/compare?runs={','.join(str(run.id) for run in self.runs)}{group}{protocol}"

    @property
    def document(self) -> ComparisonDocument:
        """The comparison as JSON has it."""
        names = [str(column.runs[0].configuration_id if self.grouped else column.runs[0].id) for column in self.columns]
        columns = [ComparedColumn(runs=column.run_ids, failed=column.failed) for column in self.columns]
        return ComparisonDocument.of(
            self,
            runs=tuple(run.id for run in self.runs),
            group="configuration" if self.grouped else None,
            columns=dict(zip(names, columns, strict=True)),
            settings={line.key: dict(zip(names, line.texts, strict=True)) for line in self.settings},
            metrics={line.metric.key: line.document(names) for line in self.metrics},
            unmarked="; ".join(entry.words for entry in self.unmarked) or None,
            not_comparable=None if self.mixed is None else self.mixed.sentences,
        )


def mixed_trajectories(runs: Sequence[RunRecord], protocol: ComparedProtocol | None) -> dict[str, tuple[int, ...]]:
    """The runs by the kind of the trajectory that was judged under ``protocol``; empty if all are of one kind."""
    if protocol is None or with_trajectory(protocol.label, TrajectoryKind.LIVE) == protocol.label:
        return {}
    kinds: dict[str, list[int]] = {}
    for run in runs:
        if run.trajectory is not None and run.id in protocol.runs:
            kinds.setdefault(run.trajectory.value, []).append(run.id)
    return {kind: tuple(members) for kind, members in sorted(kinds.items())} if len(kinds) > 1 else {}


def read_run_id(text: str) -> int:
    """The number of a run; raises InvalidInput."""
    return whole_number(text, "run", 1, _LARGEST_ID)


def read_run_ids(texts: Iterable[str]) -> tuple[int, ...]:
    """The numbers of the runs to compare, from texts such as ``3,5,8``.

    Raises:
        InvalidInput: a text is no number, a run is named twice, or there are too few or too many.
    """
    parts = [part.strip() for text in texts for part in text.split(",") if part.strip()]
    if not FEWEST_RUNS <= len(parts) <= MOST_RUNS:
        raise InvalidInput(f"{plural(len(parts), 'run')} cannot be compared", _REMEDY)
    run_ids = tuple(map(read_run_id, parts))
    twice = next((run_id for place, run_id in enumerate(run_ids) if run_id in run_ids[:place]), None)
    if twice is not None:
        raise InvalidInput(f"run {twice} is named twice", "name each run once")
    return run_ids


# Metrics side by side, and the analysis that draws the runs.

_TIME_LIMIT_S = 60.0
_UNDER_PROTOCOL = ({"form": "trajectories", "with_failed": True},)
_MEASURED = ({"form": "usage"}, {"form": "latency"})
Values = Mapping[int, Mapping[str, float]]


def metric_lines(
    columns: Sequence[RunColumn], values: Values, unmarked: Sequence[Unmarked] = ()
) -> tuple[MetricLine, ...]:
    """All metrics that a run has, in the order of the catalogue.

    Args:
        columns: What stands side by side.
        values: {run: {metric key: value}}.
        unmarked: The metrics whose better column is not marked.
    """
    known = {key: value for run_values in values.values() for key, value in run_values.items()}
    metrics = with_unknown(known)
    numbers = {metric.counted_by for metric in metrics}
    shown = [metric for metric in metrics if metric.key not in numbers]
    return tuple(
        _line(metric, columns, values, marked=not any(entry.holds_for(metric) for entry in unmarked))
        for metric in shown
    )


def _line(metric: Metric, columns: Sequence[RunColumn], values: Values, *, marked: bool) -> MetricLine:
    samples = [_sample(metric, column, values) for column in columns]
    figures = tuple(_figure(sample) for sample in samples)
    return MetricLine(metric, figures, _best(metric, columns, samples) if marked else None)


def _sample(metric: Metric, column: RunColumn, values: Values) -> list[float]:
    """The values of the good runs; those of all runs if the column is one run, which is shown as it is."""
    runs = [run for run in column.run_ids if len(column.runs) == 1 or run not in column.failed]
    return [values[run][metric.key] for run in runs if metric.key in values[run]]


def _figure(sample: Sequence[float]) -> ComparedValue | None:
    if not sample:
        return None
    if len(sample) == 1:
        return ComparedValue(mean=sample[0], count=1, low=None, high=None)
    import numpy as np  # noqa: PLC0415 - loaded for repeats only, with scipy

    from slamhive.analysis.statistics import summarise  # noqa: PLC0415

    summary = summarise(np.array(sample))
    if summary is None:
        return None
    low, high = (None, None) if summary.interval is None else (summary.interval.low, summary.interval.high)
    return ComparedValue(mean=summary.mean, count=summary.count, low=low, high=high)


def _best(metric: Metric, columns: Sequence[RunColumn], samples: Sequence[Sequence[float]]) -> int | None:
    """The column with the best mean; None on a tie, for a neutral metric, or if chance may explain the difference."""
    if metric.direction is Direction.NEUTRAL:
        return None
    sign = 1 if metric.direction is Direction.LOWER else -1
    rivals = [
        (sign * sum(sample) / len(sample), place)
        for place, (column, sample) in enumerate(zip(columns, samples, strict=True))
        if sample and column.can_be_better
    ]
    if len(rivals) < 2:
        return None
    (first, best), *others = sorted(rivals)
    tied = any(shown_digits(first) == shown_digits(mean) for mean, _ in others)
    if tied:
        return None
    for _, place in others:
        own, other = samples[best], samples[place]
        if min(len(own), len(other)) < 2:
            differ = len(own) == len(other)  # two single values are compared as they are
        else:
            import numpy as np  # noqa: PLC0415 - loaded for repeats only, with scipy

            from slamhive.analysis.statistics import compare_means  # noqa: PLC0415

            differ = compare_means(np.array(own), np.array(other)).decided
        if not differ:
            return None
    return best


def group_sentences(
    columns: Sequence[RunColumn], values: Values, protocol: ComparedProtocol, baseline: int
) -> tuple[str, ...]:
    """Sentences on the repeats of each column beside those of the column at the place ``baseline``.

    The tests are those of the answer of an experiment.
    """
    from slamhive.services.experiments import RankEntry, pair_sentence  # noqa: PLC0415 - for repeats only
    from slamhive.store.experiments import CellSample  # noqa: PLC0415

    label = ProtocolLabel(protocol.fingerprint, protocol.label)

    def entry(place: int) -> RankEntry:
        column = columns[place]
        sample = [values[run][ERROR] for run in column.run_ids if run not in column.failed and ERROR in values[run]]
        spread = variance(sample) if len(sample) > 1 else 0.0
        good = CellSample(place, label, len(sample), fmean(sample), spread) if sample else None
        return RankEntry(place, good, len(column.failed), len(sample) + len(column.failed))

    names = [f"configuration {column.runs[0].configuration_id}" for column in columns]
    told = [
        pair_sentence(names[place], entry(place), names[baseline], entry(baseline))
        for place in range(len(columns))
        if place != baseline
    ]
    return tuple(text[0].upper() + text[1:] for text in told)


def colour_order(comparison: RunComparison) -> list[int]:
    """List the meanings of the plot colours in order: configurations if they are grouped, otherwise runs."""
    first = (column.runs[0] for column in comparison.columns)
    return [run.configuration_id if comparison.grouped else run.id for run in first]


def analysis_text(comparison: RunComparison) -> str:
    """The analysis file that draws the runs of a comparison."""
    return _metric_text(comparison, (*_UNDER_PROTOCOL, *_MEASURED), _fingerprint(comparison))


def plots_of(comparison: RunComparison, analyses: AnalysisService) -> tuple[Plot, ...]:
    """The plots of a comparison; a plot that does not fit the runs says why.

    What was measured during the runs does not depend on the protocol, so it is drawn for runs of other protocols too.
    Raises InvalidInput if no run has been evaluated.
    """
    from slamhive.services.analysis import AnalysisLimits  # noqa: PLC0415 - loads pandas and scipy

    limits = AnalysisLimits(len(comparison.runs), _TIME_LIMIT_S)
    parts = ((_UNDER_PROTOCOL, _fingerprint(comparison)), (_MEASURED, None))
    texts = [_metric_text(comparison, forms, protocol) for forms, protocol in parts]
    return tuple(plot for text in texts for plot in analyses.compute(analyses.read(text, "comparison"), limits).forms)


def _metric_text(comparison: RunComparison, forms: Sequence[Mapping[str, object]], protocol: str | None) -> str:
    numbers = [run.id for run in comparison.runs]
    look = {
        "coloured_by": "configuration" if comparison.grouped else "run",
        "colour_order": colour_order(comparison),
        "folded": comparison.grouped,
    }
    content = {
        "name": f"Runs {', '.join(map(str, numbers))}",
        "select": {"runs": {"runs": numbers}},
        **({} if protocol is None else {"protocol": protocol}),
        "forms": [{**form, **look} for form in forms],
    }
    return strict_yaml.dump(content)


def _fingerprint(comparison: RunComparison) -> str | None:
    return None if comparison.protocol is None else comparison.protocol.fingerprint


# Settings as texts, to see what differs.


def setting_lines(columns: Sequence[Sequence[Mapping[str, str]]]) -> tuple[SettingLine, ...]:
    """All settings of the columns, each column with the settings of its runs; repeats list their different values."""
    keys = dict.fromkeys(key for column in columns for settings in column for key in settings)
    return tuple(SettingLine(key, tuple(_joined(column, key) for column in columns)) for key in keys)


def settings_of(run: RunRecord, record: Mapping[str, Any]) -> dict[str, str]:
    """The settings of a run that it states, then its parameters by ``parameter.<key>``.

    Args:
        run: The run.
        record: The content of its ``run.json``, which holds the parameters taken from sensors.
    """
    known = {
        "algorithm": run.algorithm,
        "version": run.version_label,
        "dataset": run.dataset,
        "pre-processing": "; ".join(map(str, run.variant)) or "none",
        "trajectory": None if run.trajectory is None else run.trajectory.value,
    }
    if run.executor != IMPORTED:
        known |= {
            "playback": f"{run.playback.mode.value} × {run.playback.rate:g}",
            "executor": run.executor,
            "CPU limit [cores]": None if run.cpu_cores is None else f"{run.cpu_cores:g}",
            "memory limit [MB]": None if run.memory_mb is None else str(run.memory_mb),
            "slowed down": None if run.slow_down == NO_SLOW_DOWN else f"{run.slow_down:g} times",
            "seed": str(run.seed),
        }
    match = _match(record)
    sensors = {} if match is None else {f"sensor {role}": used.name for role, used in match.sensors.items()}
    bound = {} if match is None else {key: entry.value for key, entry in match.parameters.items()}
    parameters = {f"parameter.{key}": _text(value) for key, value in {**bound, **run.parameters}.items()}
    return {key: text for key, text in known.items() if text is not None} | sensors | parameters


def _match(record: Mapping[str, Any]) -> MatchDocument | None:
    try:
        return MatchDocument.read(record["match"]) if "match" in record else None
    except InvalidInput:
        return None


def _joined(column: Sequence[Mapping[str, str]], key: str) -> str | None:
    texts = dict.fromkeys(settings[key] for settings in column if key in settings)
    return ", ".join(texts) if texts else None


def _text(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, tuple | list):
        return ", ".join(map(_text, value))
    return f"{value:.10g}" if isinstance(value, float) else str(value)


# A run among its repeats.


@dataclass(frozen=True, slots=True)
class RepeatStanding:
    """A run among its repeats: ``runs`` ascending, itself included, and its neighbours, None at the ends.

    ``place`` is 1 for the smallest ATE among the ``judged`` ones, which are good and of the same protocol; None if the
    run is not one of them.
    """

    runs: tuple[int, ...]
    previous: int | None
    next: int | None
    place: int | None
    judged: int


def standing_of(run: RunRecord, repeats: Sequence[RunRecord]) -> RepeatStanding:
    """Rank a run by its ATE among its ``repeats``, which include it."""
    numbers = tuple(sorted(entry.id for entry in repeats))
    at = numbers.index(run.id)
    fingerprint = None if run.protocol is None else run.protocol.fingerprint
    errors_m = {
        entry.id: entry.metrics["ate.rmse"]
        for entry in repeats
        if entry.metrics and "ate.rmse" in entry.metrics and entry.outcome is Outcome.GOOD
        if entry.protocol is not None and entry.protocol.fingerprint == fingerprint
    }
    place = None
    if run.id in errors_m:
        place = 1 + sum(other < errors_m[run.id] for other in errors_m.values())
    return RepeatStanding(
        runs=numbers,
        previous=numbers[at - 1] if at else None,
        next=numbers[at + 1] if at + 1 < len(numbers) else None,
        place=place,
        judged=len(errors_m),
    )


# The comparison.

_MOST_NAMED = 5
_ByProtocol = Mapping[str | None, Mapping[str, float]]


class RunComparisons:
    """Puts runs side by side.

    Args:
        store: Runs, metrics and evaluations.
        runs_folder: The run folders, for the parameters that were taken from sensors.
    """

    def __init__(self, store: Store, runs_folder: Path) -> None:
        self._store = store
        self._runs_folder = runs_folder

    def of(
        self,
        run_ids: Sequence[int],
        protocol: str | None = None,
        *,
        grouped: bool = False,
        baseline: int | None = None,
    ) -> RunComparison:
        """Compare runs under one protocol.

        Args:
            run_ids: The runs, as :func:`read_run_ids` returns them.
            protocol: A fingerprint; None for the protocol that the most runs have.
            grouped: Whether the runs of a configuration are one column.
            baseline: The run from whose column differences count; None for the first one.

        Raises:
            NotFound: a run is unknown, or no run was evaluated under the protocol.
            InvalidInput: the baseline is none of the runs.
        """
        if baseline is not None and baseline not in run_ids:
            raise InvalidInput(f"the baseline {baseline} is none of the compared runs", "name one of them")
        (runs, values, protocols), mixed = self._store.read(
            lambda t: (_read(t, run_ids), t.evaluations.mixed_of(run_ids))
        )
        chosen = _chosen(protocols, runs, protocol)
        fingerprint = None if chosen is None else chosen.fingerprint
        evaluated = {run: found.get(fingerprint, {}) if fingerprint else {} for run, found in values.items()}
        shown = {run: {**values[run].get(None, {}), **found} for run, found in evaluated.items()}
        judged = {run: shown[run] if found else {} for run, found in evaluated.items()}
        columns = _columns(runs, judged, grouped=grouped)
        kinds = mixed_trajectories(runs, chosen)
        unmarked = unmarked_parts(runs, mixed_trajectories=bool(kinds))
        settings: list[list[dict[str, str]]] = []
        for column in columns:
            folders = [RunFolder(self._runs_folder / str(run.id)) for run in column.runs]
            records = [folder.read_record() if folder.record.exists() else {} for folder in folders]
            settings.append([settings_of(run, record) for run, record in zip(column.runs, records, strict=True)])
        place = next((at for at, column in enumerate(columns) if baseline in column.run_ids), 0)
        comparable = grouped and not any(entry.holds_for(CATALOGUE[ERROR]) for entry in unmarked)
        return RunComparison(
            columns=columns,
            grouped=grouped,
            protocols=protocols,
            protocol=chosen,
            settings=setting_lines(settings),
            metrics=metric_lines(columns, shown, unmarked),
            unmarked=unmarked,
            baseline=place,
            mixed=mixed if chosen is not None and (chosen.lacking or kinds) else None,
            sentences=group_sentences(columns, shown, chosen, place) if comparable and chosen is not None else (),
        )

    def standing(self, run: RunRecord, most: int) -> RepeatStanding:
        """The place of a run among the newest runs of its configuration, at most ``most`` of them."""
        runs = self._store.read(lambda t: t.runs.get_many(self.repeats(run, most), with_metrics=True))
        return standing_of(run, runs)

    def repeats(self, run: RunRecord, most: int) -> tuple[int, ...]:
        """A run and the newest other runs of its configuration, at most ``most``."""
        latest = self._store.read(lambda t: t.configuration_book.latest_runs(run.configuration_id, most))
        others = [other for other in latest if other != run.id]
        return tuple(sorted([run.id, *others[: most - 1]]))


def _read(
    t: Transaction, run_ids: Sequence[int]
) -> tuple[tuple[RunRecord, ...], dict[int, _ByProtocol], tuple[ComparedProtocol, ...]]:
    unknown = sorted(set(run_ids) - t.run_table.existing(run_ids))
    if unknown:
        shown = ", ".join(map(str, unknown[:_MOST_NAMED])) + (", ..." if len(unknown) > _MOST_NAMED else "")
        raise NotFound(f"unknown run{'s' if len(unknown) > 1 else ''} {shown}", "the page of runs lists all runs")
    runs = t.runs.get_many(run_ids, with_metrics=True)
    values: dict[int, _ByProtocol] = {run.id: t.metrics.by_protocol(run.id) for run in runs}
    labels = {
        entry.protocol.fingerprint: entry.protocol.label
        for run in runs
        for entry in t.evaluations.for_run(run.id)
        if entry.state is EvaluationState.SUCCEEDED
    }
    common: list[ComparedProtocol] = []
    for key, label in labels.items():
        having = tuple(run.id for run in runs if key in values[run.id])
        could = (run.id for run in runs if run.state is RunState.SUCCEEDED)
        kinds = {run.trajectory for run in runs if run.id in having}
        words = with_trajectory(label, *kinds) if len(kinds) == 1 else label
        common.append(
            ComparedProtocol(
                fingerprint=key,
                label=words,
                runs=having,
                lacking=tuple(run_id for run_id in could if run_id not in having),
            )
        )
    return runs, values, tuple(common)


def _chosen(
    protocols: Sequence[ComparedProtocol], runs: Sequence[RunRecord], asked: str | None
) -> ComparedProtocol | None:
    """The protocol that was asked for, or the one that the most runs have; of several, the one that lists show."""
    if asked is not None:
        found = next((entry for entry in protocols if entry.fingerprint == asked), None)
        if found is None:
            known = ", ".join(entry.fingerprint for entry in protocols[:_MOST_NAMED]) or "none"
            raise NotFound(f"no run here was evaluated under protocol {asked[:40]!r}", f"known here: {known}")
        return found
    current = Counter(run.protocol.fingerprint for run in runs if run.protocol is not None)
    return max(protocols, key=lambda entry: (len(entry.runs), current[entry.fingerprint]), default=None)


def _columns(
    runs: Sequence[RunRecord], judged: Mapping[int, Mapping[str, float]], *, grouped: bool
) -> tuple[RunColumn, ...]:
    groups: dict[int, list[RunRecord]] = {}
    for run in runs:
        groups.setdefault(run.configuration_id if grouped else run.id, []).append(run)
    return tuple(
        RunColumn(tuple(members), tuple(run.id for run in members if _failed(run, judged[run.id])))
        for members in groups.values()
    )


def _failed(run: RunRecord, values: Mapping[str, float]) -> bool:
    """Tell if a run counts as failed under the protocol of these values; a run that lacks them is not judged."""
    kind = verdict_kind(run.state, run.reason, judge(values).kind if values else None)
    return kind is not None and kind.failed
