"""The shape of an analysis file; also what its published JSON Schema is made from."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from slamhive.analysis.selection import parse_expression
from slamhive.domain.verdict import FailureRule
from slamhive.errors import InvalidInput
from slamhive.schema.validation import explained

MAX_SETS = 50
MAX_FORMS = 50
MAX_LISTED = 100_000
_SET_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,63}")
_RESERVED = {"union", "or", "intersection", "and", "minus", "without", "difference"}

Id = Annotated[int, Field(ge=1, lt=2**63)]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class SetModel(_Model):
    """A set of runs, stated in one way: a search, an experiment, run numbers, configurations or a saved search."""

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
            raise explained(InvalidInput(f"a set is stated in one way, found {found}", f"use one of {known}"))
        return self


class FailureModel(_Model):
    """When a run counts as failed besides not having ended well: instead of the rule that holds everywhere else."""

    tracked_path_below: float | None = Field(
        default=0.7, ge=0, le=1, description="Share of the path; gaps are judged by the estimate's own spacing."
    )
    tracked_fraction_below: float | None = Field(
        default=None, ge=0, le=1, description="Share of the time, by the protocol's gap; takes the place of the path."
    )
    ate_rmse_above_m: float | None = Field(default=None, gt=0)
    ate_path_above_percent: float | None = Field(default=5.0, gt=0, description="ATE RMSE in percent of the path.")
    ate_extent_above_percent: float | None = Field(
        default=50.0, gt=0, description="ATE RMSE in percent of that of an estimate that never moves."
    )
    outliers: bool = Field(default=True, description="Whether an outlier among the repeats has diverged.")

    @property
    def rule(self) -> FailureRule:
        """The rule; a file that names the share of the time alone means it instead of that of the path."""
        rule = FailureRule(**self.model_dump())
        given = self.model_fields_set
        by_time = "tracked_fraction_below" in given and "tracked_path_below" not in given
        return replace(rule, tracked_path_below=None) if by_time else rule


def _set_name(name: str) -> str:
    if not _SET_NAME.fullmatch(name) or name.lower() in _RESERVED:
        raise explained(
            InvalidInput(f"{name!r} cannot name a set", "use letters, digits and '_', the first a letter; no operator")
        )
    return name


def read_by(parse: Callable[[str], object]) -> AfterValidator:
    """What makes a text one that ``parse`` can read; its InvalidInput is reported as the mistake in the file."""

    def check(text: str) -> str:
        try:
            parse(text)
        except InvalidInput as error:
            raise explained(error) from None
        return text

    return AfterValidator(check)


class AnalysisModel(_Model):
    """An analysis: which runs, under which protocol, shown how."""

    model_config = ConfigDict(title="SLAM Hive analysis")
    format: Literal[1] = 1
    name: str = Field(min_length=1, max_length=200, description="What the analysis is called.")
    text: str = Field(default="", max_length=100_000, description="Markdown above the plots.")
    select: dict[Annotated[str, AfterValidator(_set_name)], SetModel] = Field(
        min_length=1, max_length=MAX_SETS, description="Sets of runs, each under a name of yours."
    )
    use: Annotated[str, read_by(parse_expression)] | None = Field(
        default=None, max_length=10_000, description="An expression over the sets, (a | b) - c; their union if absent."
    )
    protocol: str | None = Field(
        default=None, description="Fingerprint of the evaluation protocol; each run's current one if absent."
    )
    one: list[Literal["algorithm", "dataset"]] = Field(
        default_factory=list, description="What the selection must have one of; more is refused."
    )
    exclude_disturbed: bool = Field(
        default=False, description="Leave out runs that were measured on a disturbed machine, and say how many."
    )
    failed_when: FailureModel = Field(default_factory=FailureModel)
    forms: list[dict[str, Any]] = Field(min_length=1, max_length=MAX_FORMS, description="What is shown, in order.")
