"""Messages to people when an experiment ends, or begins to fail."""

from __future__ import annotations

import hashlib
import hmac
import json
import logging
import smtplib
import ssl
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from email.message import EmailMessage
from pathlib import Path
from typing import Annotated, Protocol
from urllib.parse import quote, urlsplit

from pydantic import Field

from slamhive.base.bounds import read_record
from slamhive.base.clock import utc_now
from slamhive.base.errors import InvalidInput, SlamHiveError, Unavailable
from slamhive.base.files import write_aside
from slamhive.base.settings import MailSecurity, Settings
from slamhive.documents.experiment import Notice, NoticeEvent
from slamhive.documents.model import Document, Moment, described
from slamhive.documents.plain import ConfigurationStanding, ExperimentStatusDocument
from slamhive.domain.names import plural
from slamhive.domain.verdict import Outcome
from slamhive.recordings.variants.cache import Busy, exclusive
from slamhive.services.experiments import is_failing, status_of
from slamhive.store import Store, Transaction
from slamhive.store.records import ExperimentRecord

logger = logging.getLogger(__name__)

TIMEOUT_S = 10.0
SIGNATURE_HEADER = "X-SLAM-Hive-Signature"
_MOST_RECIPIENTS = 50


class Channel(Protocol):
    """One way to send notices."""

    @property
    def name(self) -> str:
        """Identifies it in records and messages; holds no secret."""

    def send(self, notice: Notice) -> None:
        """Send; raises Unavailable, and then the notice is sent again later."""


@dataclass(frozen=True, slots=True)
class Webhook:
    """A POST of JSON to an address, which may hold a secret: messages name its host alone."""

    address: str
    secret: str

    @property
    def name(self) -> str:
        """Check a mail address."""
        return f"webhook {urlsplit(self.address).hostname}"

    def send(self, notice: Notice) -> None:
        """Post to the address. Redirects are not followed."""
        import requests  # noqa: PLC0415 - few installations send anything

        body = json.dumps({"text": notice.words, **notice.content}).encode()
        headers = {"Content-Type": "application/json", "User-Agent": "slamhive"}
        if self.secret:
            headers[SIGNATURE_HEADER] = f"sha256={hmac.new(self.secret.encode(), body, hashlib.sha256).hexdigest()}"
        try:
            with requests.post(
                self.address, data=body, headers=headers, timeout=TIMEOUT_S, allow_redirects=False, stream=True
            ) as answer:
                status = answer.status_code
        except requests.RequestException as error:
            raise Unavailable(f"{self.name} does not answer: {type(error).__name__}") from None
        if not 200 <= status < 300:
            raise Unavailable(f"{self.name} answered with status {status}")


@dataclass(frozen=True, slots=True)
class Mail:
    """E-mail through an SMTP server."""

    host: str
    port: int
    security: MailSecurity
    user: str
    password: str
    sender: str
    recipients: tuple[str, ...]

    @property
    def name(self) -> str:
        """Check a web address."""
        return f"e-mail by {self.host}"

    def send(self, notice: Notice) -> None:
        """Send the mail."""
        try:
            with self._connected() as server:
                if self.user:
                    server.login(self.user, self.password)
                server.send_message(self._message(notice))
        except (smtplib.SMTPException, OSError) as error:
            status = getattr(error, "smtp_code", None)
            said = type(error).__name__ if status is None else f"status {status}"
            raise Unavailable(f"{self.name} was not sent: {said}") from None

    def _connected(self) -> smtplib.SMTP:
        if self.security is MailSecurity.TLS:
            return smtplib.SMTP_SSL(self.host, self.port, timeout=TIMEOUT_S, context=ssl.create_default_context())
        server = smtplib.SMTP(self.host, self.port, timeout=TIMEOUT_S)
        if self.security is MailSecurity.STARTTLS:
            try:
                server.starttls(context=ssl.create_default_context())
            except BaseException:
                server.close()
                raise
        return server

    def _message(self, notice: Notice) -> EmailMessage:
        message = EmailMessage()
        message["From"], message["To"] = self.sender, ", ".join(self.recipients)
        message["Subject"] = f"SLAM Hive: {notice.words}"[:200]
        message["Auto-Submitted"] = "auto-generated"
        lines = [notice.words, ""]
        lines += [f"{count:>8,} {phase}" for phase, count in notice.counts.items() if count]
        if notice.failures:
            lines += ["", *(f"{count:>8,} failed: {why}" for why, count in notice.failures.items())]
        message.set_content("\n".join([*lines, "", notice.address or ""]).rstrip() + "\n")
        return message


def channels_of(settings: Settings) -> tuple[Channel, ...]:
    """The channels that the settings name; raises InvalidInput for one that cannot be used."""
    found: list[Channel] = []
    if settings.notify_webhook:
        try:
            parts = urlsplit(settings.notify_webhook)
            valid = parts.scheme in {"http", "https"} and bool(parts.hostname) and parts.port != 0
        except ValueError:
            valid = False
        if not valid:
            # The address may hold a secret, so it is not repeated.
            raise InvalidInput("NOTIFY_WEBHOOK is not an address", "write it as https://chat.example.org/hooks/...")
        found.append(Webhook(settings.notify_webhook, settings.notify_webhook_secret))
    if settings.notify_mail_to:
        recipients = tuple(part.strip() for part in settings.notify_mail_to.split(",") if part.strip())
        sender = settings.notify_mail_from or settings.smtp_user
        for text in (*recipients, sender):
            if "@" not in text or not text.isprintable() or " " in text:
                raise InvalidInput(
                    f"{text[:80]!r} is not an e-mail address",
                    "check NOTIFY_MAIL_TO and NOTIFY_MAIL_FROM",
                )
        if len(recipients) > _MOST_RECIPIENTS:
            raise InvalidInput(f"NOTIFY_MAIL_TO has {len(recipients)} addresses", f"use at most {_MOST_RECIPIENTS}")
        if not settings.smtp_host:
            raise InvalidInput("NOTIFY_MAIL_TO is set, but not SMTP_HOST", "name the server that sends e-mail")
        mail = Mail(
            host=settings.smtp_host,
            port=settings.smtp_port,
            security=settings.smtp_security,
            user=settings.smtp_user,
            password=settings.smtp_password,
            sender=sender,
            recipients=recipients,
        )
        found.append(mail)
    return tuple(found)


# ``notices.json`` in the folder of the experiment holds what was sent. It is written after the sending: a worker that
# is killed in between sends the notice again, and loses none.

RECORD = "notices.json"
LOCK = ".notices.lock"
SINCE = "notices-since"
_FAILING = "failing"
FIRST_PAUSE = timedelta(seconds=30)
LONGEST_PAUSE = timedelta(hours=1)
GIVEN_UP_AFTER = timedelta(days=2)


class Sent(Document):
    """Delivery of a notice, by channel."""

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
        # Notices are sent from this time on: experiments that are older have ended without them.
        path: Path = self._settings.ledger_folder / SINCE
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            # An experiment may have been started a moment before its first worker.
            write_aside(path, (self._now() - timedelta(minutes=10)).isoformat())
        since = datetime.fromisoformat(path.read_text(encoding="ascii"))
        records = self._store.read(lambda t: t.experiments.all())
        recent = [record for record in records if record.created_at >= since]
        return sum(self._send_due(record) for record in recent if self._done.get(record.id) != record.runs)

    def _send_due(self, experiment: ExperimentRecord) -> int:
        status = self._store.read(lambda t: _status(t, experiment))
        folder = self._settings.experiments_folder / status.name
        try:
            with exclusive(folder / LOCK):
                path = folder / RECORD
                record = NoticeRecord.read(read_record(path)) if path.exists() else NoticeRecord()
                # What there is to say, said or not, by its key. Repeats that are added later make another end.
                due: list[tuple[str, NoticeEvent]] = []
                failures = self._settings.notify_failures
                if _FAILING in record.sent or self._store.read(lambda t: is_failing(t, status, failures)):
                    due.append((_FAILING, NoticeEvent.FAILING))
                finished = status.state is ConfigurationStanding.FINISHED
                if finished and not self._store.read(lambda t: t.durations.open_evaluations(status.number)) > 0:
                    due.append((f"finished {status.runs}", NoticeEvent.FINISHED))

                arrived = 0
                for key, event in due:
                    before = record.sent.get(key, Sent())
                    base = self._settings.public_url.rstrip("/")
                    notice = Notice(
                        event=event,
                        experiment=status.name,
                        words=_words(status, event),
                        counts={phase.label: count for phase, count in status.counts.items()},
                        failures={str(failure.value): count for failure, count in status.failures.items()},
                        address=f"{base}/experiments/{quote(status.name, safe='')}" if base else None,
                        at=self._now(),
                    )
                    after = self._tried(before, notice)
                    if after != before:
                        arrived += len(after.arrived) - len(before.arrived)
                        record = NoticeRecord(sent={**record.sent, key: after})
                        write_aside(path, json.dumps(record.content, indent=1) + "\n")
                    if event is NoticeEvent.FINISHED and self._is_over(after):
                        self._done[status.number] = status.runs
                return arrived
        except Busy:  # another worker, perhaps on another machine, sends them now
            return 0

    def _is_over(self, sent: Sent) -> bool:
        """Tell if a notice has arrived everywhere, or is not tried again."""
        arrived = all(channel.name in sent.arrived for channel in self._channels)
        return arrived or (sent.first_tried is not None and self._now() - sent.first_tried > GIVEN_UP_AFTER)

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


def notices_of(settings: Settings, store: Store) -> Notices | None:
    """The notices of an installation; None if it sends none, or if its settings cannot be used, which is logged."""
    try:
        channels = channels_of(settings)
    except SlamHiveError as error:
        logger.warning("no notices are sent: %s", error)
        return None
    return Notices(settings, store, channels) if channels else None


def _status(t: Transaction, record: ExperimentRecord) -> ExperimentStatusDocument:
    return status_of(record, t.experiment_counts.by_experiment(record.id).get(record.id, []))


def _words(status: ExperimentStatusDocument, event: NoticeEvent) -> str:
    good, failed, lost = (status.counts[entry] for entry in (Outcome.GOOD, Outcome.FAILED, Outcome.LOST))
    runs = plural(status.runs, "run")
    if event is NoticeEvent.FAILING:
        return f"experiment {status.name} is failing: {failed + lost:,} of {runs} failed, the latest in a row"
    return f"experiment {status.name} has finished: {good:,} of {runs} good, {failed:,} failed" + (
        f", {lost:,} lost" if lost else ""
    )
