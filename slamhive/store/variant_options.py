"""Options of pre-processing steps, under the names that searches use."""

from __future__ import annotations

from typing import Any

from slamhive.domain.parameters import Scalar
from slamhive.domain.variant import Variant
from slamhive.store.models import TEXT_VALUE_LENGTH


def option_rows(configuration_id: int, variant: Variant) -> list[dict[str, Any]]:
    """Rows of ``variant_options``: ``KIND.OPTION`` and ``KIND.OPTION@SENSOR``, where all steps of the kind agree."""
    found: dict[str, list[Scalar]] = {}
    for step in variant:
        for option, value in step.options.items():
            name = f"{step.kind}.{option}"
            for key in (name, *(f"{name}@{sensor}" for sensor in step.sensors)):
                found.setdefault(key, []).append(value)
    return [
        {"configuration_id": configuration_id, "name": name, **_columns(values[0])}
        for name, values in found.items()
        if all(value == values[0] for value in values)
    ]


def _columns(value: Scalar) -> dict[str, Any]:
    if isinstance(value, str):
        return {"number_value": None, "text_value": value[:TEXT_VALUE_LENGTH]}
    return {"number_value": float(value), "text_value": None}
