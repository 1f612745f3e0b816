"""The answer of a gate: each metric of the baseline against the runs that are checked; as Markdown and JUnit XML."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from xml.etree import ElementTree as ET

import numpy as np

from slamhive.analysis.regression import (
    Change,
    Evidence,
    FailureCounts,
    Sample,
    decide,
    failure_equivalence,
    failure_evidence,
    over_configurations,
    rank_equivalence,
    rank_evidence,
    typical_change,
)
from slamhive.analysis.report import Cell, ResultTable, TableColumn
from slamhive.analysis.statistics import Numbers
from slamhive.base.clock import monotonic_s
from slamhive.base.errors import InvalidInput
from slamhive.documents.gate import GateAnswer, GateConfiguration, GateMetric, GateValues, MeasuredRun, MetricChange
from slamhive.documents.run import ProtocolName
from slamhive.domain.gate import FAILURES, SIGNIFICANCE, Answer, Margin
from slamhive.domain.metrics import Direction, Metric, described
from slamhive.domain.names import plural
from slamhive.domain.question import RunBudget
from slamhive.services.gates.baselines import GateCheck, RunPair
from slamhive.services.gates.service import Gates
from slamhive.services.markdown import escaped, table_markdown

# Remarks on an answer: few runs, other machines, disturbed runs.

_MEASURED = "CPU, memory and latency"


def remarks(pairs: Sequence[RunPair], significance: float) -> Iterator[str]:
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
    limits = [
        {(run.limits.cpu_cores, run.limits.memory_mb, run.limits.slow_down) for run in runs}
        for runs in (baseline, candidates)
    ]
    if all(limits) and limits[0] != limits[1]:
        yield f"The runs had other limits of CPU or memory than the baseline, so {_MEASURED} may differ."


def _texts(values: Iterable[str | None]) -> list[str]:
    return sorted({value for value in values if value is not None})


_FAILED_RUNS = Metric(FAILURES, "Failed runs", "", Direction.LOWER, "Share of the runs that failed.")


def answer_of(
    check: GateCheck, pairs: Sequence[RunPair], notes: Sequence[str], significance: float, looks: int = 1
) -> GateAnswer:
    """The answer for these pairs.

    Args:
        check: Baseline and margins.
        pairs: One or more.
        notes: What to say of runs that were left out.
        significance: The largest chance of a false alarm of this look.
        looks: The number of this look.
    """
    metrics = compared(check, pairs, significance)
    without = [
        f"No good run to check has a value of {metric.label}."
        for metric in metrics
        if all(entry.candidate is None for entry in metric.configurations)
    ]
    missing = tuple(name for name in check.baseline.names if name not in {pair.words for pair in pairs})
    answers = [entry.answer for entry in metrics]
    answer = Answer.over([*answers, Answer.UNDECIDED] if missing and not check.partial else answers)
    return GateAnswer(
        baseline=check.baseline.name,
        answer=answer,
        words=_words(answer, metrics, missing),
        significance=significance,
        looks=looks,
        metrics=tuple(metrics),
        configurations=tuple(map(_configuration, pairs)),
        missing=missing,
        notes=(*notes, *remarks(pairs, significance), *without),
    )


def compared(check: GateCheck, pairs: Sequence[RunPair], significance: float) -> list[GateMetric]:
    """The answer for each metric that the baseline has values of."""
    tested: dict[str, _Tested] = {}
    for key, margin in check.margins.items():
        parts: list[tuple[int, Evidence]] = []
        for place, pair in enumerate(pairs):
            if key == FAILURES:
                test = failure_equivalence if check.both_ways else failure_evidence
                parts.append((place, test(_failures(pair), margin)))
                continue
            baseline = ranked_values(key, pair.held.runs)
            if np.isfinite(baseline).any():
                sample = Sample(baseline, ranked_values(key, pair.measured))
                parts.append((place, (rank_equivalence if check.both_ways else rank_evidence)(sample, margin)))
        if parts:
            sizes = [(len(pairs[place].held.runs), len(pairs[place].runs)) for place, _ in parts]
            weights = [math.sqrt(n * m / (n + m)) for n, m in sizes]
            tested[key] = _Tested(over_configurations([entry for _, entry in parts], weights), parts)
    decided = decide({key: entry.evidence for key, entry in tested.items()}, significance)
    return [_compared(key, check.margins[key], decided[key], tested[key], pairs) for key in tested]


@dataclass(frozen=True, slots=True)
class _Tested:
    """The evidence over all pairs, and that of each by its place."""

    evidence: Evidence
    parts: Sequence[tuple[int, Evidence]]


def ranked_values(key: str, runs: Sequence[MeasuredRun]) -> Numbers:
    """The values of a metric so that larger is worse.

    A failed run is worse than any other in metrics of its trajectory. What it used of the machine is left out, because
    it did not do the same work.
    """
    metric = described(key)
    sign = -1.0 if metric.direction is Direction.HIGHER else 1.0
    values = []
    for run in runs:
        if run.failed is not None:
            values += [math.inf] if metric.needs_protocol else []
        elif key in run.metrics:
            values.append(sign * run.metrics[key])
    return np.array(values, dtype=float)


def _failures(pair: RunPair) -> FailureCounts:
    counts = [sum(run.failed is not None for run in runs) for runs in (pair.held.runs, pair.measured)]
    return FailureCounts(counts[0], len(pair.held.runs), counts[1], len(pair.measured))


def good_values(key: str, runs: Sequence[MeasuredRun]) -> Numbers:
    """The values of a metric of the good runs, as they are."""
    return np.array([run.metrics[key] for run in runs if run.failed is None and key in run.metrics], dtype=float)


def _compared(
    key: str, margin: Margin, decision: tuple[Answer, float], tested: _Tested, pairs: Sequence[RunPair]
) -> GateMetric:
    metric = _FAILED_RUNS if key == FAILURES else described(key)
    change = _change(key, margin, [pairs[place] for place, _ in tested.parts])
    interval = None if change is None else change.interval
    return GateMetric(
        key=key,
        label=metric.label,
        unit=metric.unit,
        better=metric.direction,
        margin=margin.words(metric.unit),
        answer=decision[0],
        change=None if change is None else change.value,
        change_low=None if interval is None else interval.low,
        change_high=None if interval is None else interval.high,
        change_relative=margin.relative,
        p_worse=decision[1],
        p_within=None if key == FAILURES else tested.evidence.within,
        configurations=tuple(_values(key, place, found, pairs[place]) for place, found in tested.parts),
    )


def _change(key: str, margin: Margin, pairs: Sequence[RunPair]) -> Change | None:
    if key == FAILURES:
        return Change(sum(_failures(pair).excess for pair in pairs) / len(pairs), None)
    values = [(good_values(key, pair.held.runs), good_values(key, pair.measured)) for pair in pairs]
    return typical_change([pair for pair in values if all(map(len, pair))], relative=margin.relative)


def _values(key: str, place: int, evidence: Evidence, pair: RunPair) -> GateValues:
    if key == FAILURES:
        counts = _failures(pair)
        baseline: float | None = counts.baseline_failed / counts.baseline
        candidate: float | None = counts.candidate_failed / counts.candidate
    else:
        good = [good_values(key, runs) for runs in (pair.held.runs, pair.measured)]
        baseline, candidate = (float(np.median(values)) if len(values) else None for values in good)
    return GateValues(
        configuration=place,
        baseline=baseline,
        candidate=candidate,
        p_worse=evidence.worse,
        p_within=None if key == FAILURES else evidence.within,
    )


def _configuration(pair: RunPair) -> GateConfiguration:
    protocol = pair.held.protocol
    return GateConfiguration(
        algorithm=pair.held.algorithm,
        dataset=pair.held.dataset,
        words=pair.words,
        protocol=ProtocolName(fingerprint=protocol.fingerprint, label=protocol.label),
        baseline_runs=len(pair.held.runs),
        baseline_failed=sum(run.failed is not None for run in pair.held.runs),
        runs=tuple(run.id for run in pair.runs),
        failed=tuple(run.id for run, values in zip(pair.runs, pair.measured, strict=True) if values.failed is not None),
        versions=tuple(sorted({run.version_label for run in pair.runs if run.version_label is not None})),
    )


def _words(answer: Answer, metrics: Sequence[GateMetric], missing: Sequence[str]) -> str:
    """The answer in one sentence."""
    if answer is Answer.PASS:
        return f"None of {plural(len(metrics), 'metric')} became worse by more than its margin."
    if answer is Answer.WORSE:
        named = [entry.label for entry in metrics if entry.answer is Answer.WORSE]
        return f"Worse by more than the margin and by more than chance: {', '.join(named)}."
    return f"{' '.join(_open_questions(metrics, missing))} More runs can decide."


def _open_questions(metrics: Sequence[GateMetric], missing: Sequence[str]) -> Iterator[str]:
    named = [entry.label for entry in metrics if entry.answer is Answer.UNDECIDED]
    if named or not metrics:
        yield f"Chance may explain what was found: {', '.join(named) or 'no metric has values'}."
    if missing:
        yield f"The baseline has {plural(len(missing), 'configuration')} without runs to check."


# Repeating runs until the gate can decide or its budget is spent.


@dataclass(frozen=True, slots=True)
class Repeats:
    """Rule for repeating runs: ``first`` of each configuration, then more within ``budget``; None: no more."""

    first: int
    budget: RunBudget | None = None
    executor: str | None = None

    def check(self, configurations: int) -> None:
        """Raise InvalidInput if the first repeats exceed the budget."""
        runs = self.first * configurations
        if self.budget is not None and self.budget.runs_left(0, 0.0) < runs:
            raise InvalidInput(
                f"{plural(self.first, 'repeat')} of {plural(configurations, 'configuration')} are {runs} runs; the "
                f"budget is {self.budget.words}",
                "give fewer --repeats or a larger --budget",
            )

    def significance(self, look: int) -> float:
        """The chance of a false alarm that look number ``look`` may have.

        Who looks again after each run finds something in the end. So with a budget each look has half the chance of the
        one before, and all looks together stay below :data:`SIGNIFICANCE`.
        """
        return SIGNIFICANCE if self.budget is None else SIGNIFICANCE / 2**look


def repeat_until_decided(
    gates: Gates,
    check: GateCheck,
    algorithms: Sequence[str],
    repeats: Repeats,
    work: Callable[[Sequence[int]], None],
    clock: Callable[[], float] = monotonic_s,
) -> GateAnswer:
    """Run the configurations of the baseline that belong to ``algorithms``, and compare.

    The number of repeats doubles from look to look, so that there are few looks. ``work`` runs the runs with these
    numbers to their end, evaluations included. Raises as :meth:`Gates.reruns` and :meth:`Gates.answer`.
    """
    reruns = gates.reruns(check, algorithms, repeats.executor)
    repeats.check(len(reruns))
    chosen = check.baseline.model_copy(update={"configurations": tuple(rerun.held for rerun in reruns)})
    check = replace(check, baseline=chosen)
    began_s = clock()
    run_ids: list[int] = []
    done, more, look = 0, repeats.first, 0
    while True:
        new = gates.start(reruns, more, done)
        work(new)
        run_ids += new
        done += more
        look += 1
        answer = gates.answer(check, run_ids, repeats.significance(look), look)
        if answer.answer is not Answer.UNDECIDED or repeats.budget is None:
            return answer
        more = min(done, repeats.budget.runs_left(len(run_ids), clock() - began_s) // len(reruns))
        if not more:
            note = f"The budget of {repeats.budget.words} is spent: {plural(len(run_ids), 'run')}."
            return answer.model_copy(update={"notes": (*answer.notes, note)})


# -- the answer of a gate as Markdown, for a comment, and as JUnit XML, for what shows tests ---------------------------


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
        return _worded(entry, entry.change), None
    return _worded(entry, entry.change), f"{_worded(entry, entry.change_low)} to {_worded(entry, entry.change_high)}"


def _worded(entry: MetricChange, value: float) -> str:
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
