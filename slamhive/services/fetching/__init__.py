"""Public sequences: the catalogue of what can be fetched, checks of its addresses, and the way to a dataset."""

from __future__ import annotations

from slamhive.services.fetching.collections import Collections
from slamhive.services.fetching.fetching import Fetching
from slamhive.services.fetching.request import FetchPlan, FetchRequest

__all__ = ["Collections", "FetchPlan", "FetchRequest", "Fetching"]
