"""Two columns against each other: one point for each run, colour by algorithm, marker by dataset."""

from __future__ import annotations

from pydantic import Field

from slamhive.analysis.chart import Chart
from slamhive.analysis.density import rule_words
from slamhive.analysis.forms.base import FORMS, Form, FormData, caption
from slamhive.analysis.forms.cloud import cloud_of
from slamhive.analysis.forms.coverage_scale import CoverageScaleOptions
from slamhive.analysis.forms.places import failed_marks, legend
from slamhive.analysis.result import FormResult


class ScatterOptions(CoverageScaleOptions):
    """``x`` and ``y`` are keys of metrics, parameters or facts."""

    x: str = Field(description="Metric or parameter on the x axis.")
    y: str = Field(description="Metric or parameter on the y axis, with numbers.")


class Scatter(Form[ScatterOptions]):
    """The plot type ``scatter``."""

    key = "scatter"
    title = "Scatter"
    description = "Any two metrics or parameters against each other, one point for each run."
    options = ScatterOptions

    def needs(self, options: ScatterOptions) -> frozenset[str]:
        """Both axes."""
        return frozenset({options.x, options.y, "tracked_fraction"})

    def build(self, data: FormData, options: ScatterOptions) -> FormResult:
        """One plot and its raw data."""
        cloud = cloud_of(data.table, [options.x, options.y], options)
        x, y = cloud.columns
        chart = Chart(
            key=f"scatter_{x.key}_{y.key}",
            title=options.title or f"{y.label} over {x.label}",
            x=cloud.axes[0],
            y=cloud.axes[1],
            marks=(*cloud.points(), *failed_marks(cloud.table, cloud.axes[0], x.key), *legend(cloud.table)),
            caption=caption(cloud.table, len(cloud.shown), cloud.protocol, cloud.scaling, rule_words(len(cloud.shown))),
        )
        return cloud.result(chart)


FORMS.register(Scatter.key, Scatter())
