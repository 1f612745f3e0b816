"""Searching runs with filters, and saved searches."""

from __future__ import annotations

from slamhive.services.searches.service import LeftOut, Searches
from slamhive.services.searches.words import order_in_words, summary

__all__ = [
    "LeftOut",
    "Searches",
    "order_in_words",
    "summary",
]
