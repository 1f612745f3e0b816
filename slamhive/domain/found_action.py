"""What can be done to all runs of a search."""

from __future__ import annotations

from enum import StrEnum


class FoundAction(StrEnum):
    """One action; its value is the last part of its address in the web API."""

    EVALUATE = "evaluate"
    RETRY = "retry"
    TAGS = "tags"
    SHARE = "share"
    DELETE = "delete"
