"""The runs of a static site as scripts: pages that are opened from a folder cannot fetch other files.

``runs/<number>.js`` has what the page of a run draws, and what ``compare.html`` puts side by side. ``assets/runs.js``
has the rows of the list.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from slamhive.domain.metrics import CATALOGUE, Metric, with_unknown
from slamhive.domain.run import RunState
from slamhive.services.reports import script_json
from slamhive.services.run_comparison import RunColumn, settings_of
from slamhive.services.runs import RunSeries
from slamhive.store.records import RunRecord
from slamhive.web.figures import PLANES, best_plane, captions, run_figures
from slamhive.web.formatting import display_unit
from slamhive.web.presenters.runs import metric_rows

POINTS = 600
"""Points per path and per error over time."""
POINTS_OF_USE = 300
"""Points of CPU, memory and latency over time. All that a site has of a run then stays below 100 kB."""
FIGURES = (
    ("path", "Trajectory"),
    ("error", "Position error over time"),
    ("latency", "Latency per frame"),
    ("cpu", "CPU over time"),
    ("memory", "Memory over time"),
)
"""The plots of a run, with their titles."""
_METRICS = ("ate.rmse", "ate.max", "rpe.trans_rmse", "tracked_fraction", "cpu.mean", "ram.max", "duration")
"""First metrics in the table, if any run has them. The pages of runs show all others."""


def thinned(series: RunSeries) -> RunSeries:
    """What a site shows of ``series``."""
    most = {"estimate": POINTS, "groundtruth": POINTS, "error": POINTS}
    most |= dict.fromkeys(("cpu", "memory", "latency"), POINTS_OF_USE)
    known = {name: getattr(series, name) for name in most}
    fewer = {name: entry.thinned(most[name]) for name, entry in known.items() if entry is not None}
    return replace(series, **fewer, dropped_s=series.dropped_s[:: max(1, len(series.dropped_s) // POINTS_OF_USE)])


def drawing(run: RunRecord, series: RunSeries, colour: str) -> dict[str, Any]:
    """The plots of a run, their captions, and why others are missing; planes of the path are made from that in 3D."""
    figures = run_figures(series, run.algorithm, colour)
    shown = series.groundtruth or series.estimate
    texts = captions(series, None if run.protocol is None else run.protocol.label)
    reasons = {"path" if key == "estimate" else key: text for key, text in series.reasons.items()}
    kept = path_once(figures)
    return {
        "figures": kept,
        "plane": None if shown is None else best_plane(shown),
        "captions": texts,
        "reasons": {key: reasons.get(key, "No data for this plot.") for key, _ in FIGURES if key not in kept},
    }


def path_once(figures: Mapping[str, Any]) -> dict[str, Any]:
    """The plots with one of the path, that in 3D: pages make its planes."""
    return {"path" if key == "path_3d" else key: figure for key, figure in figures.items() if key not in _FLAT}


def run_script(run: RunRecord, record: Mapping[str, Any], drawn: Mapping[str, Any], *, scene: bool) -> str:
    """A run as a script: what was measured and set, and its plots.

    Args:
        run: With its metrics.
        record: The content of its ``run.json``.
        drawn: As :func:`drawing` returns it.
        scene: Whether the site has a 3D view of it.
    """
    rows = [row for needs in (True, False) for row in metric_rows(run, needs_protocol=needs)]
    figures = run.metrics or {}
    failed = run.state is RunState.FAILED or (run.judged is not None and run.judged.failed)
    content = {
        "id": run.id,
        "algorithm": run.algorithm,
        "dataset": run.dataset,
        "configuration": run.configuration_id,
        "state": state_words(run),
        "failed": failed,
        "rival": RunColumn((run,), (run.id,) if failed else ()).can_be_better,
        "trajectory": None if run.trajectory is None else run.trajectory.value,
        "cpu": None if run.host is None else run.host.cpu_model,
        "protocol": None if run.protocol is None else [run.protocol.fingerprint, run.protocol.label],
        "metrics": {row.metric.key: [figures[row.metric.key], row.cell.text, row.cell.exact] for row in rows},
        "settings": settings_of(run, record),
        "scene": scene,
        **drawn,
    }
    return f"window.slamhiveRun({script_json(content)});\n"


def metric_definitions(keys: Sequence[str]) -> list[dict[str, Any]]:
    """What a comparison says of the metrics with these keys, in the order of the catalogue."""
    return [_definition(metric) for metric in with_unknown(keys)]


def _definition(metric: Metric) -> dict[str, Any]:
    return {
        "key": metric.key,
        "label": metric.label,
        "unit": display_unit(metric).unit,
        "factor": display_unit(metric).factor,
        "better": metric.direction.value,
        "group": metric.group.value if metric.needs_protocol else "measured during the run",
        "accuracy": metric.needs_protocol,
        "definition": metric.definition,
    }


def state_words(run: RunRecord) -> str:
    """The state of a run with its reason."""
    return run.state.value if run.reason is None else f"{run.state.value}: {run.reason.value}"


def table_row(run: RunRecord) -> dict[str, Any]:
    """A row of the list; metrics in their display unit."""
    figures = run.metrics or {}
    return {
        "id": run.id,
        "algorithm": run.algorithm,
        "dataset": run.dataset,
        "state": state_words(run),
        "experiment": run.experiment,
        "parameters": ", ".join(f"{key} {value}" for key, value in run.parameters.items()),
        "protocol": None if run.protocol is None else run.protocol.label,
        **{key: figures[key] * display_unit(CATALOGUE[key]).factor for key in _METRICS if key in figures},
    }


def table_script(rows: Sequence[Mapping[str, Any]]) -> str:
    """The list as a script."""
    present = {key for row in rows for key, value in row.items() if value is not None}
    plain = ("id", "algorithm", "dataset", "state", "experiment", "parameters", "protocol")
    columns = [{"key": key, "label": key, "unit": ""} for key in plain if key in present]
    columns[0]["label"] = "run"
    columns += [
        {"key": key, "label": CATALOGUE[key].label, "unit": display_unit(CATALOGUE[key]).unit}
        for key in _METRICS
        if key in present
    ]
    content = {"columns": columns, "rows": [[row.get(column["key"]) for column in columns] for row in rows]}
    return f"window.slamhiveRuns = {script_json(content)};\n"


_FLAT = frozenset(f"path_{plane}" for plane in PLANES)
