"""Analysis files written by pages: a first one for a search or an experiment, the constraint selector."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from typing import Any

from slamhive import strict_yaml
from slamhive.domain.parameters import Value
from slamhive.domain.sensors import SensorSetup
from slamhive.errors import InvalidInput
from slamhive.search.reader import quoted

FIRST = """name: A first look
text: |
  Write your text here, in Markdown.
select:
  runs: {where: %s}
forms:
  - form: by_algorithm
    metric: ate.rmse
  - form: distributions
    metrics: [ate.rmse]
"""
ALL = "id >= 1"
"""A filter that matches every run."""
ERROR = "ate.rmse"
MOST_LINES = 3
"""Parameters that an analysis of an experiment draws a metric over."""
BOUNDS = {
    "max_cores": ("cpu.mean", "<=", 1.0),
    "max_memory_mb": ("ram.max", "<=", 1e6),
    "min_tracked": ("tracked_fraction", ">=", 1.0),
    "max_ate_m": ("ate.rmse", "<=", 1.0),
}
"""Fields of the selector: metric, comparison, and the factor from the field's unit to the metric's unit."""


def first_text(where: str) -> str:
    """An analysis file for the runs that match a filter; an empty filter matches all."""
    return FIRST % json.dumps(where.strip() or ALL, ensure_ascii=False)  # a JSON string is a quoted YAML string


def experiment_text(
    name: str, axes: Mapping[str, Sequence[Value]], crossed: Callable[[str, str], bool] = lambda _first, _second: True
) -> str:
    """An analysis file for an experiment, with plots that fit what it varies.

    Args:
        name: Of the experiment.
        axes: Its axes with their values.
        crossed: Whether values of two axes are combined; values of linked axes follow from each other.
    """
    varying = [axis for axis, values in axes.items() if len(values) > 1]
    parameters = [axis for axis in varying if axis not in ("algorithm", "dataset")]
    numeric = [axis for axis in parameters if all(type(value) in (int, float) for value in axes[axis])]
    paper = {"columns": "algorithms"} if "algorithm" in varying else {}
    forms: list[dict[str, Any]] = [{"form": "table", **paper}, {"form": "by_algorithm", "metric": ERROR}]
    forms += [{"form": "line", "x": axis, "metric": ERROR} for axis in numeric[:MOST_LINES]]
    pair = next((pair for pair in combinations(parameters, 2) if crossed(*pair)), None)
    if pair is not None:
        forms.append({"form": "heatmap", "x": pair[0], "y": pair[1], "metric": ERROR})
        forms.append({"form": "importance", "metric": ERROR})
    forms.append({"form": "distributions", "metrics": [ERROR]})
    if "algorithm" in varying or parameters:
        forms.append({"form": "pareto", "metrics": ["cpu.mean", ERROR]})
    varied = f"It varies {', '.join(varying)}." if varying else "It varies nothing."
    content = {"name": name, "text": varied, "select": {"runs": {"experiment": name}}, "forms": forms}
    return strict_yaml.dump(content)


def selector_text(fields: Mapping[str, str], sensors: list[str], datasets: list[str]) -> str:
    """An analysis file that asks for configurations within limits; raises InvalidInput naming the field.

    Args:
        fields: Typed text of the fields in :data:`BOUNDS`; empty means no limit.
        sensors: Sensor setups to consider; empty means all.
        datasets: Datasets to consider; empty means all.
    """
    bounds = []
    for name, (metric, sign, factor) in BOUNDS.items():
        text = fields.get(name, "").strip()
        if text:
            bounds.append(f"{metric} {sign} {_number(name, text) * factor:g}")
    if not bounds:
        raise InvalidInput("no limit is set", "fill in at least one field")
    for name in sensors:
        if name not in list(SensorSetup):
            raise InvalidInput(f"unknown sensors {name[:40]!r}", f"use one of {', '.join(SensorSetup)}")
    conditions = []
    if sensors:
        conditions.append(f"sensor in ({', '.join(sensors)})")
    if datasets:
        conditions.append(f"dataset in ({', '.join(quoted(name[:100]) for name in datasets)})")
    content = {
        "name": "Configurations within limits",
        "select": {"candidates": {"where": " and ".join(conditions) or ALL}},
        "forms": [{"form": "selector", "bounds": bounds}],
    }
    return strict_yaml.dump(content)


def _number(name: str, text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0 <= number < 1e12:
        raise InvalidInput(f"{name.replace('_', ' ')} {text[:40]!r} is not a positive number", "for example, enter 1.5")
    return number
