"""Variants of datasets and the steps that make them, as JSON."""

from __future__ import annotations

from typing import Annotated, Any

from slamhive.domain.variant import Variant
from slamhive.schema.fields import described
from slamhive.schema.model import Document
from slamhive.schema.types import Timestamp


class CachedVariant(Document):
    """A variant in the cache."""

    key: Annotated[str, described("Identifies its recording: the same data and steps give the same key.")]
    dataset: str
    steps: Variant
    size_bytes: Annotated[int, described("Space that it takes.", unit="bytes")]
    made_at: Timestamp
    used_at: Annotated[Timestamp, described("When it was last used.")]
    in_use: bool


class StepOption(Document):
    """An option of a step."""

    name: str
    type: str
    default: Any
    required: bool
    unit: str
    allowed: Annotated[str, described("The range or the choices; empty if every value is allowed.")]
    help: str


class Step(Document):
    """A kind of step with its options."""

    kind: str
    help: str
    options: tuple[StepOption, ...]
