"""Imports of runs as JSON: the origin that ``run.json`` states, and the report of an import."""

from __future__ import annotations

from typing import Annotated

from pydantic import AliasChoices, Field

from slamhive.domain.hint import Hint
from slamhive.schema.fields import described
from slamhive.schema.model import Document

_Order = Annotated[str | None, described("Null for files without orientations, and for matrices.")]
_Because = Annotated[dict[str, str], described("Why the unit and the order are believed to be these.")]


class Origin(Document):
    """The file that an imported run comes from."""

    source: Annotated[str, described("Path of the file as the user gave it.")]
    trial: str
    format: str
    checksum: str
    time_unit: Annotated[str | None, described("Unit of its timestamps; null in records of version 0.1.")] = None
    quaternion_order: _Order = None
    because: _Because = Field(default_factory=dict)


class Reading(Document):
    """How a file was read."""

    name: str
    time_unit: str
    quaternion_order: _Order
    because: _Because


class Problem(Document):
    """A file that was not imported."""

    name: str
    text: Annotated[str, described("Why it was not imported.")]


class Import(Document):
    """What an import has done, or would do in a dry run."""

    dry_run: bool
    runs: Annotated[tuple[int, ...], described("Numbers of all runs, also of those that were imported before.")] = (
        Field(validation_alias=AliasChoices("run_ids", "runs"))
    )
    imported: Annotated[int, described("New runs.")]
    known: Annotated[int, described("Runs that were imported before.")]
    datasets: Annotated[tuple[str, ...], described("Datasets that were created from ground truths or relations.")]
    evaluated: int
    failed_evaluations: Annotated[dict[int, str], described("Why evaluations failed, by run.")]
    readings: tuple[Reading, ...]
    problems: tuple[Problem, ...]
    left_out: Annotated[tuple[str, ...], described("Files that match no pattern.")]
    hints: Annotated[dict[int, tuple[Hint, ...]], described("Likely mistakes in the input, by run.")]
