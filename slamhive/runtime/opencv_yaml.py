"""Settings files in the YAML of OpenCV's ``FileStorage``, which visual SLAM systems read."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np


def opencv_yaml(values: Mapping[str, Any]) -> str:
    """The text of a file with ``values``: numbers, text, matrices (n, m), and groups of such as nested mappings.

    A bool is written as 0 or 1. A real number always has a decimal point: some readers refuse ``500`` for one.
    """
    return "\n".join(["%YAML:1.0", "---", *_lines(values, "")]) + "\n"


def real(value: float) -> str:
    """``value`` with a decimal point, also before an exponent."""
    text = f"{float(value):.12g}"
    mantissa, mark, exponent = text.partition("e")
    return f"{mantissa if '.' in mantissa else mantissa + '.0'}{mark}{exponent}"


def matrix(values: np.ndarray, kind: str = "d") -> str:
    """A matrix (n, m); ``kind`` is OpenCV's letter, ``d`` for 64 and ``f`` for 32 bits."""
    rows, columns = values.shape
    data = ", ".join(real(value) for value in values.reshape(-1))
    return f"!!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: {kind}\n   data: [{data}]"


def _lines(values: Mapping[str, Any], indent: str) -> list[str]:
    lines = []
    for key, value in values.items():
        if isinstance(value, Mapping):
            lines += [f"{indent}{key}:", *_lines(value, indent + "   ")]
        else:
            lines.append(f"{indent}{key}: {_text(value)}")
    return lines


def _text(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return matrix(value)
    if isinstance(value, bool | int):
        return str(int(value))
    return f'"{value}"' if isinstance(value, str) else real(value)
