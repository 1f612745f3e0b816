"""Sharing: who owns runs, experiments and analyses, and who may see them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.services.sharing.service import SharingChange, Sharings

__all__ = [
    "SharingChange",
    "Sharings",
]

if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
