"""The plot types of analyses, one module each. Importing this package registers all that ship with SLAM Hive."""

from slamhive.analysis.plot_types.base import (
    PLOT_TYPES,
    PlotData,
    PlotOptions,
    PlotType,
    RunFiles,
    RunLatency,
    RunTrack,
    RunUsage,
    one_value,
)
from slamhive.analysis.plot_types.budget import BudgetCurves
from slamhive.analysis.plot_types.by_algorithm import ByAlgorithm
from slamhive.analysis.plot_types.coverage import Coverage
from slamhive.analysis.plot_types.critical_difference import CriticalDifference
from slamhive.analysis.plot_types.distributions import Distributions, Repeatability
from slamhive.analysis.plot_types.heatmap import Heatmap
from slamhive.analysis.plot_types.metric_table import MetricTable
from slamhive.analysis.plot_types.over_time import Latency, Usage
from slamhive.analysis.plot_types.parameters import Importance, LinePlot, ParallelCoordinates, Sensitivity
from slamhive.analysis.plot_types.protocols import Protocols
from slamhive.analysis.plot_types.scatter import Pareto, Scatter, Scatter3d
from slamhive.analysis.plot_types.selector import Selector
from slamhive.analysis.plot_types.trajectories import Trajectories

for _plot_type in (
    BudgetCurves(),
    ByAlgorithm(),
    Coverage(),
    CriticalDifference(),
    Distributions(),
    Heatmap(),
    Importance(),
    Latency(),
    LinePlot(),
    MetricTable(),
    ParallelCoordinates(),
    Pareto(),
    Protocols(),
    Repeatability(),
    Scatter(),
    Scatter3d(),
    Selector(),
    Sensitivity(),
    Trajectories(),
    Usage(),
):
    PLOT_TYPES.register(_plot_type.key, _plot_type)
