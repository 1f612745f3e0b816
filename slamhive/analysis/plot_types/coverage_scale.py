"""Errors scaled up for runs that cover little of their sequence, as in the extended scatter plots of the paper."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from slamhive.analysis.plot_types import base
from slamhive.analysis.table import RunTable
from slamhive.domain.metrics import Direction
from slamhive.errors import InvalidInput
from slamhive.schema.validation import explained

Share = Annotated[float, Field(ge=0, le=1)]
Multiple = Annotated[float, Field(ge=1, le=1000)]


class CoverageScaleOptions(base.PlotOptions):
    """``coverage_multiples[k]`` applies from ``coverage_thresholds[k]`` up, the last one below all thresholds."""

    coverage_thresholds: list[Share] = Field(
        default_factory=list, max_length=20, description="Descending: 0.75, 0.5 ..."
    )
    coverage_multiples: list[Multiple] = Field(default_factory=list, max_length=21, description="1, 2, 2.5 ...")

    @model_validator(mode="after")
    def _matching(self) -> CoverageScaleOptions:
        thresholds, multiples = self.coverage_thresholds, self.coverage_multiples
        if (thresholds or multiples) and len(multiples) != len(thresholds) + 1:
            found = f"{len(thresholds)} thresholds and {len(multiples)} multiples"
            raise explained(InvalidInput(f"there must be one more multiple than thresholds, found {found}"))
        if sorted(thresholds, reverse=True) != thresholds:
            raise explained(InvalidInput(f"coverage_thresholds must descend, found {thresholds}"))
        return self

    @property
    def scaled(self) -> bool:
        """Whether errors are scaled."""
        return bool(self.coverage_multiples)


def scaled_by_coverage(table: RunTable, keys: list[str], options: CoverageScaleOptions) -> tuple[RunTable, str]:
    """The table with errors among ``keys`` scaled by the tracked fraction, and a sentence for the caption."""
    errors = [
        key for key in keys if table.column(key).needs_protocol and table.column(key).direction is Direction.LOWER
    ]
    if not options.scaled or not errors:
        return table, ""
    covered = base.number_column(table.frame, "tracked_fraction")
    steps = np.array(options.coverage_thresholds[::-1])
    multiples = np.array(options.coverage_multiples[::-1])
    factor = multiples[np.searchsorted(steps, np.nan_to_num(covered), side="right")]
    frame = table.frame.assign(**{key: base.number_column(table.frame, key) * factor for key in errors})
    pairs = zip([*options.coverage_thresholds, 0], options.coverage_multiples, strict=True)
    words = ", ".join(f"{multiple:g} from {100 * threshold:g} %" for threshold, multiple in pairs)
    return table.with_rows(frame), f"{', '.join(errors)} multiplied by the share tracked: {words}."
