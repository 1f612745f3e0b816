"""A plot type of analyses: one metric over the date of the run, to see whether a new version made things worse.

An analysis file asks for it with `form: history`. Copy this file and change the options and what is drawn.
"""

from pydantic import Field

from slamhive.analysis.chart import Axis, Chart, Points
from slamhive.analysis.plot_types import PlotData, PlotOptions, PlotType
from slamhive.analysis.plot_types.base import caption, number_column, raw_table, result_of, with_values
from slamhive.analysis.report import PlotResult


class HistoryOptions(PlotOptions):
    """The options in the analysis file; `title` and `text` are there already."""

    metric: str = Field(default="ate.rmse", description="The metric to draw.")


class History(PlotType[HistoryOptions]):
    """The plot type `history`."""

    key = "history"  # the name of the entry point, and of `form` in analysis files
    title = "History"
    description = "One metric of the good runs in the order in which they were made."
    options = HistoryOptions
    column_options = ("metric",)  # the options that name metrics or parameters; no others are loaded

    def build(self, data: PlotData, options: HistoryOptions) -> PlotResult:
        """Describe the plots. SLAM Hive draws them on pages and in PDF, SVG and PNG files."""
        table = data.table  # a pandas frame with one row for each selected run, failed ones included
        metric = table.numeric(options.metric, "a history")
        protocol = table.one_protocol([metric.key])  # refuses values of several protocols side by side
        good = with_values(table, [metric.key]).sort_values("run_id")
        points = [
            Points(
                name=str(algorithm),
                x=number_column(rows, "run_id"),
                y=number_column(rows, metric.key),
                colour=table.colours[str(algorithm)],  # the same on every page
                runs=number_column(rows, "run_id").astype(int),  # a click opens the run
            )
            for algorithm, rows in good.groupby("algorithm", sort=True)
        ]
        chart = Chart(
            key=f"history_{metric.key}",
            title=options.title or f"{metric.label} over time",
            x=Axis("run"),
            y=Axis(metric.label, metric.unit),
            marks=tuple(points),
            caption=caption(table, len(good), protocol),  # how many runs, how many failed, which protocol
        )
        return result_of(
            table, protocol, (chart,), (raw_table("history_raw", table, [metric.key]),), lacking=[metric.key]
        )


PLOT_TYPE = History()
