"""Three columns against each other in space, one point for each run."""

from __future__ import annotations

from dataclasses import replace

from pydantic import Field

from slamhive.analysis.chart import Chart
from slamhive.analysis.colours import MARKERS, MARKERS_IN_SPACE
from slamhive.analysis.density import rule_words
from slamhive.analysis.forms.base import FORMS, Form, FormData, caption
from slamhive.analysis.forms.cloud import cloud_of
from slamhive.analysis.forms.places import legend
from slamhive.analysis.forms.scatter import ScatterOptions
from slamhive.analysis.result import FormResult


class Scatter3dOptions(ScatterOptions):
    """``x`` and ``y`` may hold words, ``z`` holds numbers."""

    y: str = Field(description="Metric or parameter on the y axis.")
    z: str = Field(description="Metric or parameter upwards, with numbers.")


class Scatter3d(Form[Scatter3dOptions]):
    """The plot type ``scatter_3d``."""

    key = "scatter_3d"
    title = "Scatter in 3D"
    description = "Any three metrics or parameters against each other, colour by algorithm, marker by dataset."
    options = Scatter3dOptions

    def needs(self, options: Scatter3dOptions) -> frozenset[str]:
        """All three axes."""
        return frozenset({options.x, options.y, options.z, "tracked_fraction"})

    def build(self, data: FormData, options: Scatter3dOptions) -> FormResult:
        """One plot and its raw data."""
        table = data.table
        if len(table.markers) > MARKERS_IN_SPACE:
            table = replace(table, markers=dict.fromkeys(table.markers, MARKERS[0]))
        cloud = cloud_of(table, [options.x, options.y, options.z], options)
        x, y, z = cloud.columns
        chart = Chart(
            key=f"scatter_3d_{'_'.join(cloud.keys)}",
            title=options.title or f"{z.label} over {x.label} and {y.label}",
            x=cloud.axes[0],
            y=cloud.axes[1],
            z=cloud.axes[2],
            marks=(*cloud.points(), *legend(cloud.table)),
            caption=caption(
                cloud.table,
                len(cloud.shown),
                cloud.protocol,
                "The raw data names the failed runs.",
                cloud.scaling,
                rule_words(len(cloud.shown), space=True),
            ),
            height=1.4,
        )
        return cloud.result(chart)


FORMS.register(Scatter3d.key, Scatter3d())
