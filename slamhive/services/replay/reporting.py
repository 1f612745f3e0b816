"""The answer of a replay as rows of tables, and as Markdown."""

from __future__ import annotations

from collections.abc import Sequence

from slamhive.analysis.result import Cell, ResultTable, TableColumn
from slamhive.domain.gate import FAILURES
from slamhive.domain.numbers import plural
from slamhive.domain.replay import Agreement
from slamhive.schema.replay import ReplayAnswer
from slamhive.services.gates import change_words, p_words
from slamhive.services.markdown_table import escaped, table_markdown

_SIGNS = {Agreement.AGREE: "✅", Agreement.DIFFERS: "❌", Agreement.UNDECIDED: "❔"}
METRIC_HEADS = ("Metric", "Margin", "Change", "95 % interval", "p differs", "p within", "Answer")
VALUE_HEADS = ("Configuration", "Metric", "Recorded", "Repeats", "95 % interval", "p within")
CONFIGURATION_HEADS = ("Configuration", "Version", "Recorded runs", "Failed", "Repeats", "Failed now", "Identical")


def metric_rows(answer: ReplayAnswer) -> list[tuple[Cell, ...]]:
    """The cells of each metric."""
    return [
        (
            entry.label,
            entry.margin,
            *change_words(entry),
            p_words(entry.p_differs),
            p_words(entry.p_within),
            entry.answer.value,
        )
        for entry in answer.metrics
    ]


def value_rows(answer: ReplayAnswer) -> list[tuple[Cell, ...]]:
    """The cells of each metric but the failures, in each configuration."""
    rows: list[tuple[Cell, ...]] = []
    for metric in answer.metrics:
        label = f"{metric.label} [{metric.unit}]" if metric.unit else metric.label
        for entry in metric.configurations if metric.key != FAILURES else ():
            known = entry.repeats_low is not None and entry.repeats_high is not None
            interval = f"{entry.repeats_low:.4g} to {entry.repeats_high:.4g}" if known else None
            words = answer.configurations[entry.configuration].words
            rows.append((words, label, entry.recorded, entry.repeats, interval, p_words(entry.p_within)))
    return rows


def configuration_rows(answer: ReplayAnswer) -> list[tuple[Cell, ...]]:
    """The cells of each configuration."""
    return [
        (
            entry.words,
            f"{entry.version.label} (built again)" if entry.rebuilt else entry.version.label,
            len(entry.recorded_runs),
            entry.recorded_failed,
            len(entry.runs),
            len(entry.failed),
            entry.identical,
        )
        for entry in answer.configurations
    ]


def answer_markdown(answer: ReplayAnswer) -> str:
    """A summary for a review or an issue."""
    repeats = sum(len(entry.runs) for entry in answer.configurations)
    recorded = sum(len(entry.recorded_runs) for entry in answer.configurations)
    over = plural(len(answer.configurations), "configuration")
    return "\n".join(
        [
            f"### {_SIGNS[answer.answer]} SLAM Hive replay of {escaped(answer.bundle)}: {answer.answer}",
            "",
            escaped(answer.words),
            "",
            f"{plural(repeats, 'repeat')} against {plural(recorded, 'recorded run')}, over {over}.",
            "",
            _table(METRIC_HEADS, metric_rows(answer)),
            _table(CONFIGURATION_HEADS, configuration_rows(answer)),
            _table(VALUE_HEADS, value_rows(answer)),
            *(f"- {escaped(note)}" for note in answer.notes),
            "",
        ]
    )


def _table(heads: Sequence[str], rows: Sequence[tuple[Cell, ...]]) -> str:
    columns = tuple(TableColumn(key=head, label=head) for head in heads)
    return table_markdown(ResultTable(key="replay", title="replay", columns=columns, rows=tuple(rows)))
