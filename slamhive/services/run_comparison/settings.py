"""The settings of runs in texts, to see what differs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from slamhive.domain.external import IMPORTED
from slamhive.errors import InvalidInput
from slamhive.schema.matching import Match
from slamhive.services.run_comparison.model import SettingLine
from slamhive.store.records import RunRecord


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
            "seed": str(run.seed),
        }
    match = _match(record)
    sensors = {} if match is None else {f"sensor {role}": used.name for role, used in match.sensors.items()}
    bound = {} if match is None else {key: entry.value for key, entry in match.parameters.items()}
    parameters = {f"parameter.{key}": _text(value) for key, value in {**bound, **run.parameters}.items()}
    return {key: text for key, text in known.items() if text is not None} | sensors | parameters


def _match(record: Mapping[str, Any]) -> Match | None:
    try:
        return Match.read(record["match"]) if "match" in record else None
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
