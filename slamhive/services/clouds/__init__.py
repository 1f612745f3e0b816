"""Rented machines: plan, up, status, down and sweep."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.services.clouds.service import Clouds, Swept

__all__ = ["Clouds", "Swept"]

if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
