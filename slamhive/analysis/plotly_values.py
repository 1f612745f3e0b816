"""Numbers, text and colours in the JSON of Plotly."""

from __future__ import annotations

import base64
import html
import re
from collections.abc import Iterator
from typing import Any

import numpy as np

from slamhive.analysis.chart import REFERENCE, Array, Axis
from slamhive.analysis.colours import on_dark

THEMED = "theme:groundtruth"

Json = dict[str, Any]


def with_dark_colours(figure: Json) -> Json:
    """The plot with the colours for dark pages, {colour: its lighter one}, in its layout; changes ``figure``."""
    lighter = {colour: on_dark(colour) for colour in sorted(set(_colours(figure["data"])))}
    figure["layout"]["meta"] = {"dark": {colour: other for colour, other in lighter.items() if colour != other}}
    return figure


def _colours(part: object) -> Iterator[str]:
    if isinstance(part, str):
        yield from _COLOUR.findall(part)
    elif isinstance(part, dict | list):
        for entry in part.values() if isinstance(part, dict) else part:
            yield from _colours(entry)


_COLOUR = re.compile(r"^#[0-9A-Fa-f]{6}$")


def numbers(values: Array) -> Json:
    """A typed array for Plotly: integers as int32, other numbers in single precision, enough for a screen."""
    whole = np.issubdtype(values.dtype, np.integer)
    wanted = np.ascontiguousarray(values, dtype="<i4" if whole else "<f4")
    content: Json = {"dtype": "i4" if whole else "f4", "bdata": base64.b64encode(wanted.tobytes()).decode()}
    if values.ndim > 1:
        content["shape"] = ", ".join(map(str, values.shape))
    return content


def escaped(text: str) -> str:
    """Text for Plotly, which interprets some HTML and ``%{...}``."""
    return html.escape(text, quote=False).replace("%{", "%\u200b{").replace("\n", "<br>")


def translucent(colour: str, opacity: float) -> str:
    """``#0072B2`` as ``rgba(0,114,178,0.2)``."""
    if not colour.startswith("#"):
        return f"rgba(128,128,128,{opacity:g})"
    red, green, blue = (int(colour[place : place + 2], 16) for place in (1, 3, 5))
    return f"rgba({red},{green},{blue},{opacity:g})"


def colour_of_mark(colour: str) -> str:
    """The colour to draw with; the page replaces the colour of references."""
    return "#555555" if colour == REFERENCE else colour


def meta_of(colour: str) -> Json:
    """Marks a reference, so that the page adapts its colour to light or dark mode."""
    return {"meta": THEMED} if colour == REFERENCE else {}


def drawable(x: Array, axis: Axis) -> Array:
    """Which values an axis can show: numbers, and only positive ones if it is logarithmic."""
    return np.isfinite(x) & (x > 0) if axis.log else np.isfinite(x)


def positions(values: Array, axis: Axis) -> Any:
    """Values for Plotly, which expects the names of categories instead of their positions."""
    if axis.categories is None or axis.numbered:
        return numbers(values)
    return [None if not np.isfinite(place) else escaped(axis.categories[int(place)]) for place in values]
