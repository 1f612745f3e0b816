"""The answer of a replay: the repeats against the record, in both directions."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from hashlib import sha256
from pathlib import Path

from slamhive import __version__
from slamhive.analysis.regression import median_interval
from slamhive.analysis.report import Cell, ResultTable, TableColumn
from slamhive.base.clock import utc_now
from slamhive.base.errors import InvalidInput
from slamhive.documents.gate import (
    Baseline,
    GateMetric,
    GateValues,
    ReplayAnswer,
    ReplayConfiguration,
    ReplayMetric,
    ReplayValues,
    ReplayVersion,
)
from slamhive.documents.run import ProtocolName
from slamhive.domain.gate import FAILURES, SIGNIFICANCE, Agreement
from slamhive.domain.names import plural
from slamhive.run_folder.folder import RunFolder
from slamhive.run_folder.untrusted import open_regular_file
from slamhive.services.gates import GateCheck, RunPair, change_words, compared, good_values, measured_runs, p_words
from slamhive.services.markdown import escaped, table_markdown
from slamhive.services.replay.needs import Prepared, Recorded
from slamhive.store import RunRecord, Transaction


def answer_of(
    t: Transaction, prepared: Prepared, repeats: Sequence[Sequence[RunRecord]], runs_folder: Path
) -> ReplayAnswer:
    """Compare the repeats of each configuration with its recorded runs; raises InvalidInput for incomplete ones."""
    held = tuple(entry.held for entry in prepared.configurations)
    name = prepared.request.path.name
    baseline = Baseline(name=name, made_at=utc_now(), software=__version__, where="", configurations=held)
    pairs = [
        _pair(t, words, entry, runs)
        for words, entry, runs in zip(baseline.names, prepared.configurations, repeats, strict=True)
    ]
    check = GateCheck(baseline, prepared.margins, both_ways=True)
    metrics = [_metric(entry, pairs) for entry in compared(check, pairs, SIGNIFICANCE)]
    answer = Agreement.over([entry.answer for entry in metrics])
    # The limits of the answer, one sentence each.
    notes = list(prepared.notes)
    for recorded, pair in zip(prepared.configurations, pairs, strict=True):
        if recorded.version.identity != recorded.recorded_identity:
            notes.append(
                f"{recorded.version.package} was built again from the same files: {recorded.version.identity[:19]} in "
                f"place of {recorded.recorded_identity[:19]}."
            )
        if len(recorded.runs) == 1:
            notes.append(f"{pair.words} has one recorded run: its values are taken as they are.")
        if {run.executor for run in recorded.runs} != {run.executor for run in pair.runs}:
            notes.append(
                f"{pair.words} ran with {recorded.executor}, the recorded runs with {recorded.runs[0].executor}."
            )
    old = [run for entry in prepared.configurations for run in entry.runs]
    new = [run for pair in pairs for run in pair.runs]
    models = [sorted({run.host.cpu_model for run in runs if run.host is not None}) for runs in (old, new)]
    if all(models) and models[0] != models[1]:
        notes.append(f"The processors differ: {', '.join(models[1])}; the recorded runs {', '.join(models[0])}.")
    return ReplayAnswer(
        bundle=name,
        answer=answer,
        words=_words(answer, metrics),
        significance=SIGNIFICANCE,
        metrics=tuple(metrics),
        configurations=tuple(
            _configuration(entry, pair, runs_folder) for entry, pair in zip(prepared.configurations, pairs, strict=True)
        ),
        notes=tuple(notes),
    )


def _pair(t: Transaction, words: str, entry: Recorded, runs: Sequence[RunRecord]) -> RunPair:
    for run in runs:
        if run.version is not None and run.version.identity != entry.version.identity:
            raise InvalidInput(
                f"run {run.id} ran {run.version.identity[:19]}, not {entry.version.label}", "replay again"
            )
    measured = measured_runs(t, runs, entry.held.protocol.fingerprint)
    missing = [run for run in runs if run.id not in measured]
    if missing:
        run = missing[0]
        state = "was not evaluated" if run.state.ended else "has not ended"
        raise InvalidInput(f"run {run.id}, which is {run.state}, {state}", f"slamhive runs show {run.id} says why")
    return RunPair(words, entry.held, tuple(runs), tuple(measured[run.id] for run in runs))


def _metric(found: GateMetric, pairs: Sequence[RunPair]) -> ReplayMetric:
    return ReplayMetric.of(
        found,
        answer=Agreement.of(found.answer),
        p_differs=found.p_worse,
        configurations=tuple(
            _values(found.key, values, pairs[values.configuration]) for values in found.configurations
        ),
    )


def _values(key: str, found: GateValues, pair: RunPair) -> ReplayValues:
    interval = None if key == FAILURES else median_interval(good_values(key, pair.measured))
    return ReplayValues(
        configuration=found.configuration,
        recorded=found.baseline,
        repeats=found.candidate,
        repeats_low=None if interval is None else interval.low,
        repeats_high=None if interval is None else interval.high,
        p_differs=found.p_worse,
        p_within=found.p_within,
    )


def _configuration(entry: Recorded, pair: RunPair, runs_folder: Path) -> ReplayConfiguration:
    protocol = entry.held.protocol
    version, label = entry.version, entry.runs[0].version_label
    known = set(_trajectories(entry.runs, runs_folder))
    return ReplayConfiguration(
        algorithm=entry.held.algorithm,
        dataset=entry.held.dataset,
        words=pair.words,
        protocol=ProtocolName(fingerprint=protocol.fingerprint, label=protocol.label),
        recorded_version=ReplayVersion(label=label or version.package, identity=entry.recorded_identity),
        version=ReplayVersion(label=version.label, identity=version.identity),
        rebuilt=version.identity != entry.recorded_identity,
        recorded_runs=tuple(run.id for run in entry.runs),
        recorded_failed=sum(run.failed is not None for run in entry.held.runs),
        runs=tuple(run.id for run in pair.runs),
        failed=tuple(run.id for run, values in zip(pair.runs, pair.measured, strict=True) if values.failed is not None),
        identical=sum(digest in known for digest in _trajectories(pair.runs, runs_folder)),
    )


def _trajectories(runs: Iterable[RunRecord], runs_folder: Path) -> Iterator[str]:
    """The SHA-256 of each trajectory that is there."""
    for run in runs:
        stream = open_regular_file(RunFolder(runs_folder / str(run.id)).trajectory)
        if stream is not None:
            with stream:
                yield sha256(stream.read()).hexdigest()


def _words(answer: Agreement, metrics: Sequence[ReplayMetric]) -> str:
    """The answer in one sentence."""
    named = ", ".join(entry.label for entry in metrics if entry.answer is answer)
    if answer is Agreement.AGREE:
        return f"None of {plural(len(metrics), 'metric')} differs from the record by more than its margin."
    if answer is Agreement.DIFFERS:
        return f"The repeats differ from the record by more than the margin and by more than chance: {named}."
    return f"Chance may explain what was found: {named or 'no metric has values'}. More repeats can decide."


# Tables and Markdown.

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
