"""What a webhook is sent about an experiment."""

from __future__ import annotations

from datetime import datetime
from enum import StrEnum
from typing import Annotated

from slamhive.schema.fields import described
from slamhive.schema.model import Document


class NoticeEvent(StrEnum):
    """What has happened."""

    FINISHED = "finished"
    FAILING = "failing"
    TEST = "test"


class Notice(Document):
    """One thing that has happened to an experiment."""

    event: NoticeEvent
    experiment: Annotated[str, described("Its name; empty for a test.")]
    words: Annotated[str, described("One sentence for people.")]
    counts: Annotated[dict[str, int], described("Runs by phase: good, failed, queued and so on.")]
    failures: Annotated[dict[str, int], described("Failed runs by reason.")]
    address: Annotated[str | None, described("The page of the experiment; null unless PUBLIC_URL is set.")]
    at: datetime
