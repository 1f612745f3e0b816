"""The names of version 0.1, for plug-ins that import them; new code imports ``slamhive.analysis.plot_types.base``."""

from slamhive.analysis.plot_types.base import *  # noqa: F403
from slamhive.analysis.plot_types.base import PLOT_TYPES as FORMS
from slamhive.analysis.plot_types.base import PlotData as FormData
from slamhive.analysis.plot_types.base import PlotOptions as FormOptions
from slamhive.analysis.plot_types.base import PlotType as Form
from slamhive.analysis.table import RunTable

__all__ = ["FORMS", "Form", "FormData", "FormOptions"]


def require_runs(table: RunTable) -> None:
    """Raise InvalidInput for an empty selection."""
    table.require_runs()
