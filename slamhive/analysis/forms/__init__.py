"""The forms of analysis: one module each, behind :data:`FORMS`. Importing this package registers those that ship."""

from slamhive.analysis.forms import (
    by_algorithm,
    critical_difference,
    distributions,
    heatmap,
    line,
    pareto,
    scatter,
    scatter_3d,
)
from slamhive.analysis.forms.base import FORMS, Form, FormData, FormOptions, RunFiles, RunTrack, RunUsage

__all__ = [
    "FORMS",
    "Form",
    "FormData",
    "FormOptions",
    "RunFiles",
    "RunTrack",
    "RunUsage",
    "by_algorithm",
    "critical_difference",
    "distributions",
    "heatmap",
    "line",
    "pareto",
    "scatter",
    "scatter_3d",
]
