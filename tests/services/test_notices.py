"""Messages about experiments: when they are sent, that each arrives once, and what happens if nobody answers."""

from __future__ import annotations

import hashlib
import hmac
import json
import socket
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from email import message_from_bytes
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest
from aiosmtpd.controller import Controller
from click.testing import CliRunner

from slamhive.base.clock import utc_now
from slamhive.base.errors import InvalidInput
from slamhive.base.settings import MailSecurity, Settings
from slamhive.cli import main
from slamhive.documents.experiment import Notice, NoticeEvent
from slamhive.services.experiments import ExperimentSource
from slamhive.services.hive import Hive
from slamhive.services.notices import GIVEN_UP_AFTER, RECORD, SIGNATURE_HEADER, Notices, channels_of
from slamhive.services.worker import worker

pytestmark = pytest.mark.integration

SECRET = "kept between us"
GOOD = "name: pair\nalgorithms: tiny\ndatasets: track\nparameters: {seconds: 0 | 0.01}\n"
BAD = "name: bad\nalgorithms: tiny\ndatasets: track\nparameters: {behaviour: crash, seconds: 0 | 0.01 | 0.02 | 0.03}\n"

A_TEST = Notice(event=NoticeEvent.TEST, experiment="", words="test", counts={}, failures={}, address=None, at=utc_now())


def die(*_: object) -> None:
    raise KeyboardInterrupt


@dataclass
class Inbox:
    """A webhook on 127.0.0.1, and what it was sent."""

    port: int = 0
    status: int = 200
    bodies: list[dict[str, Any]] = field(default_factory=list)
    signatures: list[tuple[str, bytes]] = field(default_factory=list)

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.port}/hooks/secret-part"


@pytest.fixture
def inbox() -> Iterator[Inbox]:
    found = Inbox()

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            if found.status == 200:
                found.bodies.append(json.loads(body))
                found.signatures.append((self.headers.get(SIGNATURE_HEADER, ""), body))
            self.send_response(found.status)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    found.port = server.server_port
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield found
    server.shutdown()
    thread.join()
    server.server_close()


class Clock:
    def __init__(self) -> None:
        self.ahead = timedelta()

    def __call__(self) -> datetime:
        return utc_now() + self.ahead


def notices(hive: Hive, inbox: Inbox, clock: Clock | None = None, **settings: Any) -> Notices:
    wanted = hive.settings.with_values({"notify_webhook": inbox.address, **settings})
    return Notices(wanted, hive.store, channels_of(wanted), clock or utc_now)


def start(hive: Hive, text: str) -> None:
    hive.experiments.start(ExperimentSource(text))


def test_an_end_is_told_once(hive: Hive, inbox: Inbox) -> None:
    sending = notices(hive, inbox, public_url="https://hive.example/", notify_webhook_secret=SECRET)
    sending.work_once()
    start(hive, GOOD)
    assert sending.work_once() == 0
    hive.worker().run(until_idle=True)
    assert sending.work_once() == 1
    assert sending.work_once() == 0
    assert notices(hive, inbox).work_once() == 0  # another process, later
    (body,) = inbox.bodies
    assert body["text"] == body["words"] == "experiment pair has finished: 2 of 2 runs good, 0 failed"
    assert (body["event"], body["address"]) == ("finished", "https://hive.example/experiments/pair")
    signature, raw = inbox.signatures[0]
    assert signature == "sha256=" + hmac.new(SECRET.encode(), raw, hashlib.sha256).hexdigest()

    hive.experiments.add_repeats("pair", 1)
    hive.worker().run(until_idle=True)
    assert sending.work_once() == 1
    assert inbox.bodies[1]["counts"]["good"] == 4


def test_an_experiment_that_fails_says_so_before_it_ends(hive: Hive, inbox: Inbox) -> None:
    sending = notices(hive, inbox)
    sending.work_once()
    start(hive, BAD)
    hive.worker(only=[1, 2]).run(until_idle=True)
    assert sending.work_once() == 0
    hive.worker(only=[1, 2, 3]).run(until_idle=True)
    assert sending.work_once() == 1
    assert hive.experiments.is_failing(hive.experiments.status("bad"))
    hive.worker().run(until_idle=True)
    assert sending.work_once() == 1
    assert [body["event"] for body in inbox.bodies] == ["failing", "finished"]
    assert inbox.bodies[0]["failures"] == {"nonzero_exit": 3}


def test_what_does_not_arrive_is_sent_again_but_not_for_ever(hive: Hive, inbox: Inbox) -> None:
    clock = Clock()
    sending = notices(hive, inbox, clock)
    sending.work_once()
    start(hive, GOOD)
    hive.worker().run(until_idle=True)
    inbox.status = 500
    assert sending.work_once() == 0
    inbox.status = 200
    assert sending.work_once() == 0  # not at once
    clock.ahead = timedelta(seconds=31)
    assert sending.work_once() == 1
    inbox.status = 302
    hive.experiments.add_repeats("pair", 1)
    hive.worker().run(until_idle=True)
    assert sending.work_once() == 0
    clock.ahead += GIVEN_UP_AFTER + timedelta(hours=2)
    inbox.status = 200
    assert sending.work_once() == 0


def test_a_worker_that_dies_before_it_notes_sends_again(
    hive: Hive, inbox: Inbox, monkeypatch: pytest.MonkeyPatch
) -> None:
    sending = notices(hive, inbox)
    sending.work_once()
    start(hive, GOOD)
    hive.worker().run(until_idle=True)
    with monkeypatch.context() as patch:
        patch.setattr("slamhive.services.notices.write_aside", die)
        with pytest.raises(KeyboardInterrupt):
            sending.work_once()
    assert not (hive.settings.experiments_folder / "pair" / RECORD).exists()
    assert notices(hive, inbox).work_once() == 1
    assert len(inbox.bodies) == 2


def test_experiments_of_before_are_not_told(hive: Hive, inbox: Inbox) -> None:
    start(hive, GOOD)
    hive.worker().run(until_idle=True)
    clock = Clock()
    clock.ahead = timedelta(hours=1)
    assert notices(hive, inbox, clock).work_once() == 0


def test_the_worker_sends_beside_its_work(hive: Hive, inbox: Inbox, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker, "NOTICES_EVERY_S", 0.05)
    hive.settings = hive.settings.with_values({"notify_webhook": inbox.address})
    start(hive, GOOD)
    hive.worker().run(until_idle=True)
    assert [body["event"] for body in inbox.bodies] == ["finished"]


class Post:
    """An SMTP server's memory."""

    def __init__(self) -> None:
        self.messages: list[tuple[list[str], bytes]] = []

    async def handle_DATA(self, _server: Any, _session: Any, envelope: Any) -> str:
        self.messages.append((envelope.rcpt_tos, envelope.content))
        return "250 kept"


@pytest.fixture
def post() -> Iterator[tuple[Post, int]]:
    handler = Post()
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    controller = Controller(handler, hostname="127.0.0.1", port=port)
    controller.start()
    yield handler, port
    controller.stop()


def test_e_mail_says_how_many_runs_are_good(hive: Hive, post: tuple[Post, int]) -> None:
    handler, port = post
    mail = {
        "notify_mail_to": "anna@lab.example, ben@lab.example",
        "notify_mail_from": "hive@lab.example",
        "smtp_host": "127.0.0.1",
        "smtp_port": port,
        "smtp_security": MailSecurity.NONE,
    }
    settings = hive.settings.with_values(mail)
    sending = Notices(settings, hive.store, channels_of(settings))
    sending.work_once()
    start(hive, GOOD)
    hive.worker().run(until_idle=True)
    assert sending.work_once() == 1
    ((recipients, raw),) = handler.messages
    message = message_from_bytes(raw)
    assert recipients == ["anna@lab.example", "ben@lab.example"]
    assert message["Subject"].replace("\n", "") == "SLAM Hive: experiment pair has finished: 2 of 2 runs good, 0 failed"
    assert "       2 good" in str(message.get_payload())
    protected = settings.with_values({"smtp_security": MailSecurity.STARTTLS})
    (channel,) = channels_of(protected)
    with pytest.raises(Exception, match="was not sent: SMTPNotSupportedError"):  # never in clear text instead
        channel.send(A_TEST)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"notify_webhook": "ftp://x/secret-part"}, "NOTIFY_WEBHOOK"),
        ({"notify_mail_to": "anna"}, "'anna'"),
        ({"notify_mail_to": "anna@lab.example"}, "is not an e-mail address"),
        ({"notify_mail_to": "anna@lab.example", "smtp_user": "hive@lab.example"}, "SMTP_HOST"),
        ({"notify_mail_to": "a@b.example\nBcc: all@b.example", "smtp_user": "h@b.example"}, "is not an e-mail address"),
    ],
)
def test_settings_that_cannot_work_are_named(settings: dict[str, Any], said: str) -> None:
    with pytest.raises(InvalidInput, match=said) as refused:
        channels_of(Settings(**settings))
    assert "secret-part" not in str(refused.value)


def test_the_command_tries_each_channel(hive: Hive, inbox: Inbox, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SLAMHIVE_DATA", str(hive.settings.data))
    monkeypatch.setenv("SLAMHIVE_NOTIFY_WEBHOOK", inbox.address)
    answer = CliRunner().invoke(main, ["notify", "test", "--json"])
    assert (answer.exit_code, json.loads(answer.stdout)[0]["arrived"]) == (0, True)
    inbox.status = 404
    answer = CliRunner().invoke(main, ["notify", "test"])
    assert answer.exit_code == 1
    assert answer.stderr.strip() == "webhook 127.0.0.1 answered with status 404"
    shown = CliRunner().invoke(main, ["settings"]).output
    assert "secret-part" not in shown
    monkeypatch.delenv("SLAMHIVE_NOTIFY_WEBHOOK")
    assert "no channel is set" in CliRunner().invoke(main, ["notify", "test"]).stderr
