"""Experiments that choose their runs: they add runs to what is undecided, and stop when they know."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.base.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.services.deciding.service import Questions


if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
