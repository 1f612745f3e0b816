"""Searching runs with filters, and saved searches."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.services.searches.service import LeftOut, Searches
    from slamhive.services.searches.words import order_in_words, summary

__all__ = [
    "LeftOut",
    "Searches",
    "order_in_words",
    "summary",
]

if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
