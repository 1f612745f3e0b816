"""The model of an analysis file; its JSON Schema is made from it."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from slamhive.analysis.selection import parse_expression
from slamhive.base.errors import InvalidInput
from slamhive.documents.validation import explained
from slamhive.domain.verdict import MOST_MISSED, FailureRule

MAX_SETS = 50
MAX_PLOTS = 50
MAX_LISTED = 100_000
_SET_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,63}")
_RESERVED = {"union", "or", "intersection", "and", "minus", "without", "difference"}

Id = Annotated[int, Field(ge=1, lt=2**63)]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class SetModel(_Model):
    """A set of runs, given by exactly one field."""

    where: str | None = Field(default=None, min_length=1, description="A filter, as on the page of runs.")
    experiment: str | None = Field(default=None, min_length=1, description="All runs of an experiment.")
    runs: list[Id] | None = Field(default=None, min_length=1, max_length=MAX_LISTED, description="Numbers of runs.")
    configurations: list[Id] | None = Field(
        default=None, min_length=1, max_length=MAX_LISTED, description="All runs of these configurations."
    )
    search: str | None = Field(default=None, min_length=1, description="The name of a saved search.")
    group: str | None = Field(default=None, min_length=1, description="The name of a group of configurations.")

    @model_validator(mode="after")
    def _one_way(self) -> SetModel:
        given = [name for name in type(self).model_fields if getattr(self, name) is not None]
        if len(given) != 1:
            found = " and ".join(given) or "nothing"
            known = ", ".join(type(self).model_fields)
            raise explained(InvalidInput(f"a set needs exactly one field, found {found}", f"use one of {known}"))
        return self


class FailureModel(_Model):
    """Rule by which a run that ended well counts as failed; replaces the rule that applies elsewhere."""

    tracked_path_below: float | None = Field(
        default=0.7, ge=0, le=1, description="Share of the path; gaps relate to the spacing of the estimate."
    )
    tracked_fraction_below: float | None = Field(
        default=None,
        ge=0,
        le=1,
        description="Share of the time, by the protocol's gap; replaces the share of the path.",
    )
    ate_rmse_above_m: float | None = Field(default=None, gt=0)
    ate_path_above_percent: float | None = Field(default=5.0, gt=0, description="ATE RMSE in percent of the path.")
    ate_extent_above_percent: float | None = Field(
        default=50.0, gt=0, description="ATE RMSE in percent of the ATE RMSE of an estimate that never moves."
    )
    outliers: bool = Field(default=True, description="Whether an outlier among repeats counts as diverged.")
    missed_input_above: float | None = Field(
        default=MOST_MISSED, ge=0, le=1, description="Share of the input frames that may not reach the algorithm."
    )

    @property
    def rule(self) -> FailureRule:
        """The rule; a file that names only the share of the time replaces the share of the path by it."""
        rule = FailureRule(**self.model_dump())
        given = self.model_fields_set
        by_time = "tracked_fraction_below" in given and "tracked_path_below" not in given
        return replace(rule, tracked_path_below=None) if by_time else rule


def _set_name(name: str) -> str:
    if not _SET_NAME.fullmatch(name) or name.lower() in _RESERVED:
        raise explained(
            InvalidInput(
                f"{name!r} cannot name a set", "use letters, digits and '_', begin with a letter, and use no operator"
            )
        )
    return name


def read_by(parse: Callable[[str], object]) -> AfterValidator:
    """A validator that accepts what ``parse`` reads, and reports its InvalidInput."""

    def check(text: str) -> str:
        try:
            parse(text)
        except InvalidInput as error:
            raise explained(error) from None
        return text

    return AfterValidator(check)


class AnalysisModel(_Model):
    """An analysis: its runs, protocol and plots."""

    model_config = ConfigDict(title="SLAM Hive analysis")
    format: Literal[1] = 1
    name: str = Field(min_length=1, max_length=200, description="Name of the analysis.")
    text: str = Field(default="", max_length=100_000, description="Markdown above the plots.")
    select: dict[Annotated[str, AfterValidator(_set_name)], SetModel] = Field(
        min_length=1, max_length=MAX_SETS, description="Sets of runs by name."
    )
    use: Annotated[str, read_by(parse_expression)] | None = Field(
        default=None,
        max_length=10_000,
        description="An expression over the sets, such as (a | b) - c; their union if absent.",
    )
    protocol: str | None = Field(
        default=None, description="Fingerprint of the evaluation protocol; the current protocol of each run if absent."
    )
    one: list[Literal["algorithm", "dataset"]] = Field(
        default_factory=list, description="The selection must have only one of these."
    )
    exclude_disturbed: bool = Field(
        default=False, description="Leave out runs that were measured on a disturbed machine, and report their number."
    )
    failed_when: FailureModel = Field(default_factory=FailureModel)
    forms: list[dict[str, Any]] = Field(
        min_length=1, max_length=MAX_PLOTS, description="The plots in order; 'form' names the plot type."
    )
