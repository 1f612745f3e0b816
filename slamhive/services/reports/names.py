"""Whether the columns that an analysis file names can exist, before anything is computed."""

from __future__ import annotations

from collections.abc import Callable

from slamhive.analysis.analysis_file import Analysis
from slamhive.analysis.table import FACTS
from slamhive.domain.attributes import ATTRIBUTE_KINDS
from slamhive.domain.metrics import CATALOGUE
from slamhive.errors import InvalidInput
from slamhive.search.fields import VARIANT_PREFIX, Vocabulary


def check_columns(analysis: Analysis, vocabulary: Vocabulary, is_axis: Callable[[str], bool]) -> None:
    """Refuse names that no run can have a column for.

    Args:
        analysis: The file.
        vocabulary: The parameters and options of this installation.
        is_axis: Whether an experiment may have an axis of this name.

    Raises:
        InvalidInput: with the place in the file and the nearest name.
    """
    facts = {column.key for column in FACTS} | {kind.name for kind in ATTRIBUTE_KINDS}
    known = facts.union(CATALOGUE, vocabulary.parameters)
    for plot in analysis.plots:
        for key in sorted(plot.plot_type.needs(plot.options)):
            if key not in known and not key.startswith(VARIANT_PREFIX) and not is_axis(key):
                raise InvalidInput(f"{plot.place}: nothing is called {key[:80]!r}", vocabulary.nearest(key[:80]))
