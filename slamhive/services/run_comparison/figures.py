"""Metrics side by side, and the analysis that draws the runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from slamhive import strict_yaml
from slamhive.domain.metrics import Direction, Metric, with_unknown
from slamhive.services.run_comparison.marks import Unmarked
from slamhive.services.run_comparison.model import Figure, MetricLine, RunColumn, RunComparison, shown_digits

if TYPE_CHECKING:
    from slamhive.analysis.report import Plot
    from slamhive.services.reports import Analyses

_TIME_LIMIT_S = 60.0
_UNDER_PROTOCOL = ({"form": "trajectories", "with_failed": True, "in_3d": True},)
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


def _figure(sample: Sequence[float]) -> Figure | None:
    if not sample:
        return None
    if len(sample) == 1:
        return Figure(sample[0], 1)
    import numpy as np  # noqa: PLC0415 - loaded for repeats only, with scipy

    from slamhive.analysis.statistics import summarise  # noqa: PLC0415

    summary = summarise(np.array(sample))
    if summary is None:
        return None
    ends = (None, None) if summary.interval is None else (summary.interval.low, summary.interval.high)
    return Figure(summary.mean, summary.count, *ends)


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
    return None if tied or not all(_differ(samples[best], samples[place]) for _, place in others) else best


def _differ(first: Sequence[float], second: Sequence[float]) -> bool:
    """Whether two groups differ by more than chance. Two single values are compared as they are."""
    if min(len(first), len(second)) < 2:
        return len(first) == len(second)
    import numpy as np  # noqa: PLC0415 - loaded for repeats only, with scipy

    from slamhive.analysis.statistics import compare_means  # noqa: PLC0415

    return compare_means(np.array(first), np.array(second)).decided


def colour_order(comparison: RunComparison) -> list[int]:
    """What the colours of the plots mean, in order: configurations if they are grouped, otherwise runs."""
    first = (column.runs[0] for column in comparison.columns)
    return [run.configuration_id if comparison.grouped else run.id for run in first]


def analysis_text(comparison: RunComparison) -> str:
    """The analysis file that draws the runs of a comparison."""
    return _text(comparison, (*_UNDER_PROTOCOL, *_MEASURED), _fingerprint(comparison))


def plots_of(comparison: RunComparison, analyses: Analyses) -> tuple[Plot, ...]:
    """The plots of a comparison; a plot that does not fit the runs says why.

    What was measured during the runs does not depend on the protocol, so it is drawn for runs of other protocols too.
    Raises InvalidInput if no run has been evaluated.
    """
    from slamhive.services.reports import AnalysisLimits  # noqa: PLC0415 - loads pandas and scipy

    limits = AnalysisLimits(len(comparison.runs), _TIME_LIMIT_S)
    parts = ((_UNDER_PROTOCOL, _fingerprint(comparison)), (_MEASURED, None))
    texts = [_text(comparison, forms, protocol) for forms, protocol in parts]
    return tuple(plot for text in texts for plot in analyses.compute(analyses.read(text, "comparison"), limits).forms)


def _text(comparison: RunComparison, forms: Sequence[Mapping[str, object]], protocol: str | None) -> str:
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
