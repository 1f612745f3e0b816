"""Rents a cluster from a server in this process: Libcloud's requests reach it without a socket."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
import requests
import urllib3
from werkzeug.test import Client

from slamhive.base.errors import SlamHiveError
from slamhive.cloud.lifecycle import Hands, Rising, remove_all, take_down
from slamhive.cloud.plan import CloudFile, Work, make_plan
from slamhive.cloud.providers import open_provider
from slamhive.cloud.resources import CloudRecords
from slamhive.documents.machines import CloudRecord, CloudState
from tests.cloud.cloud_world import ENDPOINT, KEYS, FakeTime


@contextmanager
def answered_by(app: Any) -> Iterator[None]:
    """Every request goes to the WSGI application ``app``, as it is on the wire, without a socket."""
    client = Client(app)

    def send(self: requests.adapters.HTTPAdapter, request: requests.PreparedRequest, **_: Any) -> requests.Response:
        answer = client.open(
            request.path_url, base_url=ENDPOINT, method=request.method, headers=dict(request.headers), data=request.body
        )
        if answer.status_code == 444:
            raise requests.ConnectionError("connection reset")
        raw = urllib3.HTTPResponse(
            io.BytesIO(answer.get_data()),
            status=answer.status_code,
            headers=dict(answer.headers),
            preload_content=False,
        )
        return self.build_response(request, raw)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(requests.adapters.HTTPAdapter, "send", send)
        yield


def _nothing(*_: object) -> None:
    """A machine that needs no preparation."""


def new_record(order: CloudFile, now: datetime) -> CloudRecord:
    """The record of a cluster that is to be brought up."""
    plan = make_plan(order, Work(10.0), now)
    return CloudRecord(
        name="bench",
        uid="0123456789abcdef" * 2,
        state=CloudState.UP,
        made_at=now,
        ends_at=plan.ends_at(now),
        order="",
        plan=plan,
    )


class Rental:
    """Rents one cluster of ``order`` from the server that answers, and gives it back."""

    def __init__(self, order: CloudFile, folder: Path, prepare: Callable[..., None] = _nothing) -> None:
        self.order = order
        self.time = FakeTime()
        self.records = CloudRecords(folder)
        self.provider = open_provider(order.provider, order.region, ENDPOINT, KEYS, self.time.clock)
        self.told: list[str] = []
        self._prepare = prepare

    @property
    def hands(self) -> Hands:
        """What the cluster is made with."""
        return Hands(
            provider=self.provider,
            records=self.records,
            clock=self.time.clock,
            prepare=self._prepare,
            join="join --token j0in-secret",
            public_key="ssh-ed25519 AAAA test",
            tell=self.told.append,
        )

    def up(self) -> CloudRecord:
        """Bring it up, or go on."""
        record = self.records.find("bench")
        if record is None:
            record = self.records.write(new_record(self.order, self.time.now))
        return Rising(self.hands, self.order, record).up()

    def down(self) -> int:
        """Take it down."""
        return take_down(self.hands, self.records.get("bench"))

    def sweep(self) -> int:
        """Remove everything with our tags."""
        return remove_all(self.hands, lambda _: True)

    def tries(self, action: Callable[[], Any]) -> bool:
        """Whether ``action`` ended without an explained error."""
        try:
            action()
        except SlamHiveError:
            return False
        return True
