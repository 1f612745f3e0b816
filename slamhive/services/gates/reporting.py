"""The answer of a gate as Markdown, for a comment, and as JUnit XML, for what shows tests."""

from __future__ import annotations

from collections.abc import Sequence
from xml.etree import ElementTree as ET

from slamhive.analysis.report import Cell, ResultTable, TableColumn
from slamhive.documents.gate import GateAnswer, GateMetric, MetricChange
from slamhive.domain.gate import FAILURES, Answer
from slamhive.domain.names import plural
from slamhive.services.markdown import escaped, table_markdown

_SIGNS = {Answer.PASS: "✅", Answer.WORSE: "❌", Answer.UNDECIDED: "❔"}
METRIC_HEADS = ("Metric", "Margin", "Change", "95 % interval", "p worse", "p within", "Answer")
VALUE_HEADS = ("Configuration", "Metric", "Baseline", "Now", "p worse", "p within")


def answer_markdown(answer: GateAnswer) -> str:
    """A summary for a pull request; the values of each configuration are folded."""
    compared = sum(len(entry.runs) for entry in answer.configurations)
    held = sum(entry.baseline_runs for entry in answer.configurations)
    over = plural(len(answer.configurations), "configuration")
    notes = [*answer.notes, *(f"No runs of {words}." for words in answer.missing)]
    metrics = _table("metrics", METRIC_HEADS, [metric_row(entry) for entry in answer.metrics])
    values = _table("values", VALUE_HEADS, value_rows(answer))
    return "\n".join(
        [
            f"### {_SIGNS[answer.answer]} SLAM Hive gate {escaped(answer.baseline)}: {answer.answer}",
            "",
            escaped(answer.words),
            "",
            f"{plural(compared, 'run')} against {held} of the baseline, over {over}.",
            "",
            table_markdown(metrics),
            *(f"- {escaped(note)}" for note in notes),
            "",
            "<details><summary>Medians of each configuration</summary>",
            "",
            table_markdown(values),
            "</details>",
            "",
        ]
    )


def answer_junit(answer: GateAnswer) -> str:
    """JUnit XML: one test case for each metric. What is worse is a failure, what is undecided is skipped."""
    cases: list[ET.Element] = []
    for entry in answer.metrics:
        case = ET.Element("testcase", classname=f"gate.{answer.baseline}", name=entry.key)
        change, interval = change_words(entry)
        message = f"{entry.label} changed by {change or 'an unknown amount'}"
        message += f" (95 % interval {interval})" if interval else ""
        message += f"; the margin is {entry.margin}, the p value of worse {p_words(entry.p_worse)}"
        if entry.answer is Answer.WORSE:
            ET.SubElement(case, "failure", message=message, type="worse")
        elif entry.answer is Answer.UNDECIDED:
            ET.SubElement(case, "skipped", message=f"undecided: {message}")
        cases.append(case)
    if answer.missing:
        case = ET.Element("testcase", classname=f"gate.{answer.baseline}", name="configurations")
        ET.SubElement(case, "skipped", message=f"no runs of {', '.join(answer.missing)}")
        cases.append(case)
    suite = ET.Element(
        "testsuite",
        name=f"slamhive gate {answer.baseline}",
        tests=str(len(cases)),
        failures=str(sum(case.find("failure") is not None for case in cases)),
        errors="0",
        skipped=str(sum(case.find("skipped") is not None for case in cases)),
    )
    suite.extend(cases)
    ET.SubElement(suite, "system-out").text = "\n".join([answer.words, *answer.notes])
    root = ET.Element("testsuites")
    root.append(suite)
    ET.indent(root)
    text: bytes = ET.tostring(root, encoding="utf-8", xml_declaration=True)
    return text.decode() + "\n"


def metric_row(entry: GateMetric) -> tuple[Cell, ...]:
    """The cells of a metric, as tables show them."""
    change, interval = change_words(entry)
    p_values = p_words(entry.p_worse), p_words(entry.p_within)
    return entry.label, entry.margin, change, interval, *p_values, entry.answer.value


def value_rows(answer: GateAnswer) -> list[tuple[Cell, ...]]:
    """The cells of each metric in each configuration."""
    rows: list[tuple[Cell, ...]] = []
    for place, configuration in enumerate(answer.configurations):
        failed = f"{configuration.baseline_failed} of {configuration.baseline_runs}"
        failed_now = f"{len(configuration.failed)} of {len(configuration.runs)}"
        rows.append((configuration.words, "Failed runs", failed, failed_now, None, None))
        for metric in answer.metrics:
            found = [entry for entry in metric.configurations if entry.configuration == place]
            for entry in found if metric.key != FAILURES else []:
                label = f"{metric.label} [{metric.unit}]" if metric.unit else metric.label
                p_values = p_words(entry.p_worse), p_words(entry.p_within)
                rows.append((configuration.words, label, entry.baseline, entry.candidate, *p_values))
    return rows


def change_words(entry: MetricChange) -> tuple[str | None, str | None]:
    """The change and its interval: ``+4.2 %`` and ``-1.0 % to +9.3 %``; None where there is none."""
    if entry.change is None:
        return None, None
    if entry.change_low is None or entry.change_high is None:
        return _change(entry, entry.change), None
    return _change(entry, entry.change), f"{_change(entry, entry.change_low)} to {_change(entry, entry.change_high)}"


def _change(entry: MetricChange, value: float) -> str:
    return f"{100 * value:+.1f} %" if entry.change_relative else f"{value:+.3g} {entry.unit}".strip()


def p_words(value: float | None) -> str | None:
    """A p value as tables show it."""
    if value is None:
        return None
    return f"{value:.2g}" if value >= 0.001 else "< 0.001"


def _table(key: str, headings: Sequence[str], rows: Sequence[tuple[Cell, ...]]) -> ResultTable:
    return ResultTable(
        key=key, title=key, columns=tuple(TableColumn(key=head, label=head) for head in headings), rows=tuple(rows)
    )
