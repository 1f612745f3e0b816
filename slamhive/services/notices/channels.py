"""The ways in which a notice reaches people: a webhook, and e-mail."""

from __future__ import annotations

import hashlib
import hmac
import json
import smtplib
import ssl
from dataclasses import dataclass
from email.message import EmailMessage
from typing import Protocol
from urllib.parse import urlsplit

from slamhive.errors import InvalidInput, Unavailable
from slamhive.schema.notice import Notice
from slamhive.settings import MailSecurity, Settings

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
        """See :class:`Channel`."""
        return f"webhook {urlsplit(self.address).hostname}"

    def send(self, notice: Notice) -> None:
        """See :class:`Channel`. Redirects are not followed."""
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
        """See :class:`Channel`."""
        return f"e-mail by {self.host}"

    def send(self, notice: Notice) -> None:
        """See :class:`Channel`."""
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
        found.append(Webhook(_checked_address(settings.notify_webhook), settings.notify_webhook_secret))
    if settings.notify_mail_to:
        found.append(_mail(settings))
    return tuple(found)


def _checked_address(text: str) -> str:
    try:
        parts = urlsplit(text)
        valid = parts.scheme in {"http", "https"} and bool(parts.hostname) and parts.port != 0
    except ValueError:
        valid = False
    if not valid:
        # The address may hold a secret, so it is not repeated.
        raise InvalidInput("NOTIFY_WEBHOOK is no address", "write it as https://chat.example.org/hooks/...")
    return text


def _mail(settings: Settings) -> Mail:
    recipients = tuple(part.strip() for part in settings.notify_mail_to.split(",") if part.strip())
    sender = settings.notify_mail_from or settings.smtp_user
    for text in (*recipients, sender):
        if "@" not in text or not text.isprintable() or " " in text:
            raise InvalidInput(
                f"{text[:80]!r} is no e-mail address",
                "check NOTIFY_MAIL_TO and NOTIFY_MAIL_FROM",
            )
    if len(recipients) > _MOST_RECIPIENTS:
        raise InvalidInput(f"NOTIFY_MAIL_TO has {len(recipients)} addresses", f"use at most {_MOST_RECIPIENTS}")
    if not settings.smtp_host:
        raise InvalidInput("NOTIFY_MAIL_TO is set, but not SMTP_HOST", "name the server that sends e-mail")
    return Mail(
        host=settings.smtp_host,
        port=settings.smtp_port,
        security=settings.smtp_security,
        user=settings.smtp_user,
        password=settings.smtp_password,
        sender=sender,
        recipients=recipients,
    )
