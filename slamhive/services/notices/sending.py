"""Finds what is to be said about experiments, and sends each notice until it has arrived once by each channel.

What was sent is in ``notices.json`` in the folder of the experiment. It is written after the sending: if the worker is
killed in between, the notice is sent again, and never lost.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime, timedelta
from pathlib import Path
from typing import Annotated
from urllib.parse import quote

from pydantic import Field

from slamhive.bags.variants.locks import Busy, exclusive
from slamhive.clock import utc_now
from slamhive.domain.numbers import plural
from slamhive.errors import SlamHiveError, Unavailable
from slamhive.files import write_aside
from slamhive.input_bounds import read_record
from slamhive.schema.fields import described
from slamhive.schema.model import Document
from slamhive.schema.notice import Notice, NoticeEvent
from slamhive.schema.types import Moment
from slamhive.services.experiments import ExperimentStatus, Phase, Standing, is_failing, status_of
from slamhive.services.notices.channels import Channel, channels_of
from slamhive.settings import Settings
from slamhive.store import Store, Transaction
from slamhive.store.experiment_records import ExperimentRecord

logger = logging.getLogger(__name__)

RECORD = "notices.json"
LOCK = ".notices.lock"
SINCE = "notices-since"
_FAILING = "failing"
FIRST_PAUSE = timedelta(seconds=30)
LONGEST_PAUSE = timedelta(hours=1)
GIVEN_UP_AFTER = timedelta(days=2)


class Sent(Document):
    """What has happened to a notice, by channel."""

    arrived: tuple[str, ...] = ()
    first_tried: Moment | None = None
    next_try: Moment | None = None


class NoticeRecord(Document):
    """``notices.json``. Keys name what a notice is about, such as ``finished 195``."""

    sent: Annotated[dict[str, Sent], described("By what the notice is about.")] = Field(default_factory=dict)


class Notices:
    """The notices of one installation.

    Args:
        settings: Where to send, and when an experiment counts as failing.
        store: The database.
        channels: Where to send.
        clock: The time.
    """

    def __init__(
        self, settings: Settings, store: Store, channels: Sequence[Channel], clock: Callable[[], datetime] = utc_now
    ) -> None:
        self._settings = settings
        self._store = store
        self._channels = channels
        self._now = clock
        self._done: dict[int, int] = {}
        """Experiments about which all is said, and how many runs they had then."""

    def work_once(self) -> int:
        """Send what is to be sent now; how many messages have arrived."""
        since = self._since()
        records = self._store.read(lambda t: t.experiments.all())
        recent = [record for record in records if record.created_at >= since]
        return sum(self._send_due(record) for record in recent if self._done.get(record.id) != record.runs)

    def _send_due(self, experiment: ExperimentRecord) -> int:
        status = self._store.read(lambda t: _status(t, experiment))
        folder = self._settings.experiments_folder / status.name
        try:
            with exclusive(folder / LOCK):
                return self._send_in_turn(status, folder / RECORD)
        except Busy:  # another worker, perhaps on another machine, sends them now
            return 0

    def _send_in_turn(self, status: ExperimentStatus, path: Path) -> int:
        record = NoticeRecord.read(read_record(path)) if path.exists() else NoticeRecord()
        arrived = 0
        for key, event in self._due(status, record):
            before = record.sent.get(key, Sent())
            after = self._tried(before, self._notice(status, event))
            if after != before:
                arrived += len(after.arrived) - len(before.arrived)
                record = NoticeRecord(sent={**record.sent, key: after})
                write_aside(path, json.dumps(record.content, indent=1) + "\n")
            if event is NoticeEvent.FINISHED and self._is_over(after):
                self._done[status.id] = status.runs
        return arrived

    def _due(self, status: ExperimentStatus, record: NoticeRecord) -> Iterator[tuple[str, NoticeEvent]]:
        """What is to be said about an experiment, whether or not it was said, and the key of each."""
        if _FAILING in record.sent or self._is_failing(status):
            yield _FAILING, NoticeEvent.FAILING
        if status.standing is Standing.FINISHED and not self._evaluates(status):
            # Repeats that are added later make another end.
            yield f"finished {status.runs}", NoticeEvent.FINISHED

    def _is_failing(self, status: ExperimentStatus) -> bool:
        return self._store.read(lambda t: is_failing(t, status, self._settings.notify_failures))

    def _is_over(self, sent: Sent) -> bool:
        """Whether a notice has arrived everywhere, or is not tried again."""
        arrived = all(channel.name in sent.arrived for channel in self._channels)
        return arrived or (sent.first_tried is not None and self._now() - sent.first_tried > GIVEN_UP_AFTER)

    def _evaluates(self, status: ExperimentStatus) -> bool:
        return self._store.read(lambda t: t.durations.open_evaluations(status.id)) > 0

    def _tried(self, before: Sent, notice: Notice) -> Sent:
        """Send a notice where it has not arrived, if it is time to try."""
        now = self._now()
        first = before.first_tried or now
        waiting = [channel for channel in self._channels if channel.name not in before.arrived]
        too_early = before.next_try is not None and now < before.next_try
        if not waiting or too_early or now - first > GIVEN_UP_AFTER:
            return before
        arrived, problem = list(before.arrived), False
        for channel in waiting:
            try:
                channel.send(notice)
            except Unavailable as error:
                logger.warning("the notice that %s did not arrive: %s", notice.words, error)
                problem = True
            else:
                arrived.append(channel.name)
        pause = max(FIRST_PAUSE, min(now - first, LONGEST_PAUSE))
        return Sent(arrived=tuple(arrived), first_tried=first, next_try=now + pause if problem else None)

    def _notice(self, status: ExperimentStatus, event: NoticeEvent) -> Notice:
        base = self._settings.public_url.rstrip("/")
        return Notice(
            event=event,
            experiment=status.name,
            words=_words(status, event),
            counts={phase.label: count for phase, count in status.counts.items()},
            failures={str(failure.value): count for failure, count in status.failures.items()},
            address=f"{base}/experiments/{quote(status.name, safe='')}" if base else None,
            at=self._now(),
        )

    def _since(self) -> datetime:
        """Since when notices are sent. Experiments that are older have ended without them."""
        path: Path = self._settings.ledger_folder / SINCE
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            # An experiment may have been started a moment before its first worker.
            write_aside(path, (self._now() - timedelta(minutes=10)).isoformat())
        return datetime.fromisoformat(path.read_text(encoding="ascii"))


def notices_of(settings: Settings, store: Store) -> Notices | None:
    """The notices of an installation; None if it sends none, or if its settings cannot be used, which is logged."""
    try:
        channels = channels_of(settings)
    except SlamHiveError as error:
        logger.warning("no notices are sent: %s", error)
        return None
    return Notices(settings, store, channels) if channels else None


def _status(t: Transaction, record: ExperimentRecord) -> ExperimentStatus:
    return status_of(record, t.experiment_counts.by_experiment(record.id).get(record.id, []))


def _words(status: ExperimentStatus, event: NoticeEvent) -> str:
    failed, good = status.counts[Phase.FAILED], status.counts[Phase.GOOD]
    runs = plural(status.runs, "run")
    if event is NoticeEvent.FAILING:
        return f"experiment {status.name} is failing: {failed:,} of {runs} failed, the latest in a row"
    return f"experiment {status.name} has finished: {good:,} of {runs} good, {failed:,} failed"
