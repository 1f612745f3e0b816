"""Plug-ins as JSON."""

from __future__ import annotations

from typing import Annotated

from pydantic import BeforeValidator

from slamhive.schema.fields import described
from slamhive.schema.model import Document


class PlugIn(Document):
    """What fills one seam."""

    seam: str
    name: str
    package: Annotated[str, described("The Python package that it comes from.")]
    version: str
    entry_point: Annotated[str | None, BeforeValidator(lambda text: text or None)]
    state: Annotated[str, described("loaded or broken.")]
    problem: Annotated[str | None, described("Why it cannot be used.")]
    remedy: Annotated[str | None, described("What to do about it.")]
