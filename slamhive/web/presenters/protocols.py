"""Metrics of a run by protocol and by published tool, for its page."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from slamhive.domain.metrics import Group, described
from slamhive.domain.protocol import ALIGNMENT_LABELS
from slamhive.services.evaluations import NOT_EVALUATED, ToolFigures, presets
from slamhive.store.records import EvaluationRecord, EvaluationState, RunRecord
from slamhive.web.formatting import display_unit, metric_cell
from slamhive.web.presenters.runs import MetricRow, metric_rows


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
    figures: tuple[MetricRow, ...]


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
) -> dict[str, list[MetricRow]]:
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
                MetricRow(
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
