"""Runs for tables and pages."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from slamhive.documents.catalogue import BoundParameter, MatchDocument
from slamhive.domain.algorithm import IMPORTED, Algorithm
from slamhive.domain.configuration import PlaybackMode
from slamhive.domain.matching import Origin
from slamhive.domain.metrics import Group, Metric, described, with_unknown
from slamhive.domain.parameters import Parameter, Value, default_values
from slamhive.domain.protocol import ALIGNMENT_LABELS
from slamhive.domain.run import REMEDIES, RunState
from slamhive.domain.trust import DISTURBED
from slamhive.domain.verdict import Verdict, VerdictKind, not_evaluable
from slamhive.services.evaluations import NOT_EVALUATED, ToolFigures, presets
from slamhive.services.run_comparison import RepeatStanding
from slamhive.store.records import EvaluationRecord, EvaluationState, RunRecord
from slamhive.web.columns import ColumnKind, ListColumn
from slamhive.web.formatting import (
    DASH,
    TableCell,
    display_unit,
    duration,
    metric_cell,
    plural,
    significant,
    value_text,
)

_PROTECTIONS = {
    "held_by": "Enforced by",
    "processes": "Processes and threads",
    "memory": "Memory",
    "cpu": "CPU",
    "end": "Killed by",
    "priority": "Priority",
}


_STILLS = {"path": "traj_trajectories.png", "error": "ape_raw.png"}
_MEASURED_STILLS = {"cpu": "profiling_cpu.png", "memory": "profiling_ram.png"}


@dataclass(frozen=True, slots=True)
class ListRow:
    """One run in a table: the record, and its cells in column order."""

    run: RunRecord
    cells: tuple[tuple[ListColumn, TableCell], ...]


@dataclass(frozen=True, slots=True)
class ParameterRow:
    """One parameter of a run with its definition."""

    key: str
    value: str
    default: str
    unit: str
    help: str
    changed: bool


@dataclass(frozen=True, slots=True)
class RunMetricRow:
    """One metric of a run; ``sample`` says how many pairs or segments it uses, empty if it uses none."""

    metric: Metric
    cell: TableCell
    unit: str
    sample: str = ""


@dataclass(frozen=True, slots=True)
class Tile:
    """A number to read at a glance: ``text`` with its unit, and a ``note`` below; ``exact`` on hover."""

    title: str
    text: str
    unit: str
    note: str
    exact: str = ""


def tiles(run: RunRecord, standing: RepeatStanding) -> list[Tile]:
    """The six numbers that say how a run went; none before it has any."""
    values = run.metrics or {}
    if not values:
        return []
    judged = "not evaluated" if run.protocol is None else "not known"
    fed = "not known of imported runs" if run.executor == IMPORTED else "not reported by the algorithm"
    known = values.get
    losses, dropped = known("tracking.losses"), known("frames.dropped")
    median_s, ram_bytes = known("latency.median"), known("ram.max")
    # Such as "2nd best of 5 repeats".
    place = standing.place
    if place is None or standing.judged < 2:
        rank = "no good repeat to compare with"
    elif place == 1:
        rank = f"best of {standing.judged} repeats"
    else:
        ending = "th" if place % 100 in {11, 12, 13} else {1: "st", 2: "nd", 3: "rd"}.get(place % 10, "th")
        rank = f"{place}{ending} best of {standing.judged} repeats"
    notes = {
        "ate.rmse": rank,
        "rpe.rmse": described("rpe.rmse").sample(values),
        "tracked_fraction": "" if losses is None else plural(int(losses), "loss", "losses"),
        "frames.dropped_fraction": "" if dropped is None else plural(int(dropped), "frame"),
        "latency.p95": "" if median_s is None else f"median {significant(median_s)} s",
        "cpu.mean": "" if ram_bytes is None else f"RAM {significant(ram_bytes * 1e-6)} MB at most",
    }
    missing = {"ate.rmse": judged, "rpe.rmse": judged, "tracked_fraction": judged, "cpu.mean": "not sampled"}
    found = []
    for key, note in notes.items():
        metric, value = described(key), known(key)
        title = "CPU mean and RAM" if key == "cpu.mean" else metric.label
        if value is None:
            found.append(Tile(title, DASH, "", missing.get(key, fed)))
            continue
        unit = display_unit(metric)
        exact = f"{metric.definition} {value!r} {metric.unit}".strip()
        text = significant(value * unit.factor)
        found.append(Tile(title, text, "core" if (text, unit.unit) == ("1", "cores") else unit.unit, note, exact))
    return found


def rows(runs: Iterable[RunRecord], columns: Iterable[ListColumn], algorithms: Iterable[Algorithm]) -> list[ListRow]:
    """Table rows. ``algorithms`` define the default parameter values."""
    defaults = {algorithm.name: algorithm.parameters for algorithm in algorithms}
    chosen = tuple(columns)
    return [
        ListRow(
            run,
            tuple(
                (
                    column,
                    changed_cell(run.algorithm, run.parameters, defaults)
                    if column.kind is ColumnKind.PARAMETERS
                    else column.cell(run),
                )
                for column in chosen
            ),
        )
        for run in runs
    ]


def parameter_rows(run: RunRecord, algorithm: Algorithm | None, match: MatchDocument | None) -> list[ParameterRow]:
    """All parameters of the run, with those that differ from the default, or from what the sensors say, marked."""
    known = {} if algorithm is None else {parameter.key: parameter for parameter in algorithm.parameters}
    bound = {} if match is None else match.parameters
    stated = []
    for key, value in run.parameters.items():
        definition = known.get(key)
        if key in bound:
            continue
        if definition is None:
            why = "no longer a parameter of this algorithm"
            stated.append(ParameterRow(key, value_text(value), DASH, "", why, changed=False))
        else:
            default, unit, words = definition.default, definition.unit, definition.help
            row = ParameterRow(key, value_text(value), value_text(default), unit, words, changed=value != default)
            stated.append(row)
    return [*stated, *(_bound_row(key, entry, known.get(key)) for key, entry in bound.items())]


def metric_rows(run: RunRecord, *, needs_protocol: bool) -> list[RunMetricRow]:
    """Metrics of the evaluation (``needs_protocol``), or those measured during the run.

    Numbers of pairs and segments are shown next to their metrics and have no row of their own.
    """
    values = run.metrics or {}
    shown = [metric for metric in with_unknown(values) if metric.needs_protocol is needs_protocol]
    numbers = {metric.counted_by for metric in shown}
    return [
        RunMetricRow(metric, metric_cell(metric, values[metric.key]), display_unit(metric).unit, metric.sample(values))
        for metric in shown
        if metric.key not in numbers
    ]


def outcome(run: RunRecord) -> str:
    """The state of the run as a sentence."""
    if run.state is RunState.SUCCEEDED:
        return _success(run)
    if run.state is RunState.FAILED:
        reason = "unknown reason" if run.reason is None else run.reason.value.replace("_", " ")
        return f"Failed: {reason}. {_sentence(run.detail) if run.detail else ''}".strip()
    if run.state is RunState.CANCELLED:
        return f"Cancelled. {run.detail or ''}".strip()
    if run.state is RunState.QUEUED:
        return "Waiting for a worker."
    return f"In progress: {run.state.value}."


def remedy(run: RunRecord) -> str:
    """The remedy for a failed run; empty for any other."""
    return _sentence(REMEDIES[run.reason]) if run.state is RunState.FAILED and run.reason is not None else ""


def verdict(run: RunRecord, evaluations: Sequence[EvaluationRecord]) -> Verdict | None:
    """The verdict of the run; None without a verdict, or if the outcome already says it."""
    found = run.verdict
    if found is None or run.state is RunState.FAILED:
        return None
    if found.kind is not VerdictKind.NOT_EVALUABLE:
        return found
    reasons = [entry.reason for entry in evaluations if entry.reason]
    return not_evaluable(reasons[-1] if reasons else None)


def disturbed(run: RunRecord) -> str:
    """Why the run is disturbed, what that affects, and what to do; empty if it is not."""
    if run.disturbance is None or not run.disturbance.disturbed:
        return ""
    affected = "CPU time, duration and latency depend on the load"
    if run.playback.mode is PlaybackMode.SEQUENTIAL:
        meaning = f"{affected}; the estimate does not, because playback was sequential"
    else:
        meaning = f"{affected}, and dropped frames and errors do too, because playback was in real time"
    remedies = _sentence("; ".join(run.disturbance.remedies))
    return f"Measured on a disturbed machine: {run.disturbance.words}. {meaning}. {remedies}"


def trust_words(run: RunRecord) -> list[str]:
    """Why the run cannot be trusted fully, and what to do: one text for each reason."""
    if run.trust is None:
        return []
    return [
        disturbed(run) if reason.kind == DISTURBED else f"{_sentence(reason.words)} {_sentence(reason.remedy)}"
        for reason in run.trust.reasons
    ]


def machine(run: RunRecord) -> TableCell | None:
    """The disturbance of a finished run, and what was not recorded, with the reasons on hover."""
    if run.executor == IMPORTED or run.state not in (RunState.SUCCEEDED, RunState.FAILED):
        return None
    if run.disturbance is None:
        return TableCell("disturbance not recorded")
    not_measured, exact = run.disturbance.not_measured, "; ".join(run.disturbance.not_measured)
    if run.disturbance.disturbed is None:
        return TableCell(f"disturbance unknown: {not_measured[0]}" if not_measured else "disturbance unknown", exact)
    words = "disturbed" if run.disturbance.disturbed else "undisturbed"
    missing = ", ".join(text.partition(":")[0] for text in not_measured)
    return TableCell(f"{words} (not recorded: {missing})" if missing else words, exact)


def protections(record: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The ways in which the limits of the run were enforced; empty for imported runs and runs of early versions."""
    told = record.get("protections")
    if not isinstance(told, Mapping):
        return []
    rows = [(label, str(told[key])) for key, label in _PROTECTIONS.items() if key in told]
    missing = told.get("does_not_hold")
    if isinstance(missing, Mapping):
        rows += [(f"No {way}", str(reason)) for way, reason in missing.items()]
    return rows


def gpu(record: Mapping[str, Any]) -> TableCell | None:
    """The GPU that the run had; None if it had none."""
    told = record.get("gpu")
    if not isinstance(told, Mapping):
        return None
    number, node = told.get("number"), told.get("node")
    place = f"GPU{'' if number is None else f' {number}'} of node {node}" if node else ""
    driver = f"driver {told['driver']}" if told.get("driver") else ""
    known = [str(part) for part in (place, driver, told.get("uuid")) if part]
    return TableCell(str(told.get("model") or place or "GPU"), ", ".join(known))


def wall_time_s(run: RunRecord) -> float | None:
    """Time from the start to the end; None until the run has ended, because only the live progress stays right."""
    if run.started_at is None or run.ended_at is None:
        return None
    return (run.ended_at - run.started_at).total_seconds()


def flatten(record: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Nested provenance as dotted names and texts, in its own order; empty values become a dash."""
    found: list[tuple[str, str]] = []
    for key, value in record.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping) and value:
            found += flatten(value, f"{name}.")
        elif isinstance(value, list) and value and all(isinstance(entry, Mapping) for entry in value):
            for place, entry in enumerate(value):
                found += flatten(entry, f"{name}.{place}.")
        elif isinstance(value, list) and value:
            found.append((name, ", ".join(map(str, value))))
        else:
            found.append((name, DASH if value is None or value in ("", [], {}) else value_text(value)))
    return found


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}."


def _success(run: RunRecord) -> str:
    parts = ["Succeeded"]
    time_s = wall_time_s(run)
    if time_s is not None:
        parts.append(f" in {duration(time_s)}")
    if run.poses is not None:
        parts.append(f" with {plural(run.poses, 'pose')}")
    ate_m = (run.metrics or {}).get("ate.rmse")
    if ate_m is not None and run.protocol is not None:
        parts.append(f"; ATE RMSE {significant(ate_m)} m ({run.protocol.label})")
    # The first part counts the poses.
    remarks = (run.detail or "").partition("; ")[2]
    return "".join(parts) + "." + (f" {remarks[0].upper()}{remarks[1:]}." if remarks else "")


def changed_cell(
    algorithm: str, parameters: Mapping[str, Value], definitions: Mapping[str, tuple[Parameter, ...]]
) -> TableCell:
    """Parameters that differ from their defaults; all of them on hover."""
    everything = ", ".join(f"{key}={value_text(value)}" for key, value in parameters.items())
    known = definitions.get(algorithm)
    if known is None:
        return TableCell(everything or DASH, everything)
    default = default_values(known)
    changed = {key: value for key, value in parameters.items() if default.get(key) != value}
    text = ", ".join(f"{key}={value_text(value)}" for key, value in changed.items())
    return TableCell(text or "defaults", everything, missing=not changed)


def _bound_row(key: str, entry: BoundParameter, definition: Parameter | None) -> ParameterRow:
    unit, help_text = ("", "") if definition is None else (definition.unit, definition.help)
    changed = entry.origin is not Origin.SENSOR
    return ParameterRow(key, value_text(entry.value), entry.words, unit, help_text, changed=changed)


def stills(files: Collection[str], fingerprint: str | None) -> dict[str, str]:
    """The pictures to show without scripts, {plot: its file}, as far as they are among ``files``."""
    wanted = _MEASURED_STILLS | {plot: f"{fingerprint}-{name}" for plot, name in _STILLS.items()}
    return {plot: key for plot, key in wanted.items() if key in files}


# -- metrics of a run by protocol and by published tool ----------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ProtocolChoice:
    """A protocol under which a run has metrics.

    ``preset``: its name, or empty. ``current``: lists show it. ``chosen``: this page shows it.
    """

    fingerprint: str
    label: str
    preset: str
    current: bool
    chosen: bool


@dataclass(frozen=True, slots=True)
class ToolRow:
    """The metrics that one tool would report."""

    tool: ToolFigures
    figures: tuple[RunMetricRow, ...]


def protocol_choices(
    run: RunRecord, evaluations: Iterable[EvaluationRecord], asked: str | None
) -> list[ProtocolChoice]:
    """The protocols under which the run has metrics, oldest first. The requested or the current one is chosen."""
    succeeded = (entry.protocol for entry in evaluations if entry.state is EvaluationState.SUCCEEDED)
    labels = {protocol.fingerprint: protocol.label for protocol in succeeded}
    current = None if run.protocol is None else run.protocol.fingerprint
    chosen = asked if asked in labels else current
    names = {preset.protocol.fingerprint: name for name, preset in presets()}
    return [
        ProtocolChoice(key, label, names.get(key, ""), key == current, key == chosen) for key, label in labels.items()
    ]


def accuracy_rows(
    run: RunRecord, choices: Iterable[ProtocolChoice], figures: Mapping[str, dict[str, float]]
) -> dict[str, list[RunMetricRow]]:
    """The metrics of the chosen protocol by group, in the order of the catalogue."""
    chosen = next((entry.fingerprint for entry in choices if entry.chosen), None)
    if chosen is None:
        return {}
    rows = metric_rows(replace(run, metrics=figures.get(chosen, {})), needs_protocol=True)
    groups = ((group.value, [row for row in rows if row.metric.group is group]) for group in Group)
    return {name: members for name, members in groups if members}


def missing_by_reason(missing: Mapping[str, str]) -> dict[str, list[str]]:
    """{reason: keys of the missing metrics}."""
    keys: dict[str, list[str]] = {}
    for key, reason in missing.items():
        keys.setdefault(reason, []).append(key)
    return keys


def tool_rows(tools: Iterable[ToolFigures]) -> list[ToolRow]:
    """The metrics of each tool, in display units."""
    return [
        ToolRow(
            tool,
            tuple(
                RunMetricRow(
                    described(key),
                    metric_cell(described(key), value),
                    display_unit(described(key)).unit,
                    tool.samples.get(key, ""),
                )
                for key, value in tool.figures.items()
            ),
        )
        for tool in tools
    ]


def waiting(tools: Iterable[ToolFigures]) -> int:
    """Number of tools whose protocol has not been evaluated for the run."""
    return sum(tool.note == NOT_EVALUATED for tool in tools)


def protocol_groups() -> dict[str, dict[str, str]]:
    """Protocols to evaluate under: {group: {name: label}}."""
    return {
        "alignment, otherwise defaults": {alignment.value: label for alignment, label in ALIGNMENT_LABELS.items()},
        "published tools": {name: preset.title for name, preset in presets()},
    }
