"""Results as JSON and back, so that a plot can be drawn again long after it was computed."""

from __future__ import annotations

import base64
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from slamhive.analysis import chart as chart_types
from slamhive.analysis import result as result_types
from slamhive.errors import InvalidInput

_KIND = "is"
_ARRAY = "array"
_NAMES: dict[type[Any], str] = {
    **{
        kind: kind.__name__
        for kind in (
            chart_types.Axis,
            chart_types.Points,
            chart_types.FailedRuns,
            chart_types.Line,
            chart_types.Bars,
            chart_types.Boxes,
            chart_types.Cells,
            chart_types.Density,
            chart_types.Segments,
            chart_types.Labels,
            chart_types.Dimension,
            chart_types.Parallel,
            chart_types.Chart,
            result_types.TableColumn,
            result_types.ResultTable,
            result_types.Exclusion,
        )
    },
    result_types.PlotResult: "FormResult",  # as stored by version 0.1
}
_TYPES = {name: kind for kind, name in _NAMES.items()}


def to_json(value: Any) -> Any:
    """A plot, a table or a whole result as plain JSON; arrays in base64, little-endian."""
    if isinstance(value, np.ndarray):
        whole = np.issubdtype(value.dtype, np.integer)
        wanted = np.ascontiguousarray(value, dtype="<i8" if whole else "<f8")
        return {_KIND: _ARRAY, "dtype": wanted.dtype.str, "shape": value.shape, "data": _text(wanted.tobytes())}
    if is_dataclass(value) and not isinstance(value, type):
        content = {field.name: to_json(getattr(value, field.name)) for field in fields(value)}
        return {_KIND: _NAMES[type(value)], **content}
    if isinstance(value, tuple | list):
        return [to_json(entry) for entry in value]
    return value


def from_json(content: Any) -> Any:
    """What :func:`to_json` wrote; raises InvalidInput for anything else."""
    try:
        return _read(content)
    except (KeyError, TypeError, ValueError) as error:
        raise InvalidInput(f"the stored result is damaged: {error!r}", "run the analysis again") from None


def _read(content: Any) -> Any:
    if isinstance(content, list):
        return tuple(_read(entry) for entry in content)
    if not isinstance(content, dict):
        return content
    if content[_KIND] == _ARRAY:
        data = np.frombuffer(base64.b64decode(content["data"], validate=True), dtype=np.dtype(content["dtype"]))
        return data.reshape(content["shape"])
    kind = _TYPES[content[_KIND]]
    return kind(**{name: _read(entry) for name, entry in content.items() if name != _KIND})


def _text(data: bytes) -> str:
    return base64.b64encode(data).decode()
