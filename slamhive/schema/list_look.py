"""The fields that say how a list of runs looks."""

from __future__ import annotations

from typing import Annotated

from slamhive.domain.list_look import MOST_PINNED
from slamhive.schema.fields import described

Pinned = Annotated[int, described("How many of the first columns stay in view.", ge=0, le=MOST_PINNED)]
Colours = Annotated[bool, described("Metrics have a background by their value.")]
Sparks = Annotated[bool, described("Errors over time, or the repeats of a configuration, are drawn in the list.")]
