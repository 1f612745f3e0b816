"""The end of a worker, by the control groups that processes were seen in."""

from __future__ import annotations

import os

import pytest

from slamhive.services.doctor import SessionPlace, lifetime, lifetime_here, place_of

# The first three and ROOT_SSH are shaped as on Debian 12 with control groups version 2; the others are made up.
SSH = "0::/user.slice/user-1000.slice/session-3.scope\n"
SCOPE = "0::/user.slice/user-1000.slice/user@1000.service/app.slice/run-r1b6b8.scope\n"
USER_SERVICE = "0::/user.slice/user-1000.slice/user@1000.service/app.slice/slamhive-worker.service/worker\n"
SYSTEM_SERVICE = "0::/system.slice/slamhive-worker.service\n"
ROOT_SSH = "0::/user.slice/user-0.slice/session-1.scope\n"
CONTAINER = "0::/\n"
V1 = "4:memory:/user.slice\n1:name=systemd:/user.slice/user-1000.slice/user@1000.service/a.scope\n0::/\n"
V1_WITHOUT_SYSTEMD = "3:cpu,cpuacct:/docker/ab\n2:pids:/docker/ab\n"


@pytest.mark.parametrize(
    ("groups", "place"),
    [
        (SSH, SessionPlace.SESSION),
        (ROOT_SSH, SessionPlace.SESSION),
        (SCOPE, SessionPlace.USER),
        (USER_SERVICE, SessionPlace.USER),
        (V1, SessionPlace.USER),
        (SYSTEM_SERVICE, SessionPlace.SYSTEM),
        (CONTAINER, SessionPlace.NONE),
        (V1_WITHOUT_SYSTEMD, SessionPlace.NONE),
        ("", SessionPlace.NONE),
    ],
)
def test_the_control_group_names_the_unit(groups, place):
    assert place_of(groups) is place


@pytest.mark.parametrize("place", [SessionPlace.USER, SessionPlace.SESSION])
def test_without_lingering_the_last_logout_ends_it(monkeypatch, place):
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    found = lifetime(place, "dev", lingers=False)
    assert "last session" in found.found
    assert (found.remedy or "").startswith("sudo loginctl enable-linger $USER")


@pytest.mark.parametrize(
    ("place", "lingers", "words"),
    [
        (SessionPlace.USER, True, "user dev lingers"),
        (SessionPlace.SESSION, True, "ends when its terminal closes"),
        (SessionPlace.SYSTEM, False, "no logout ends it"),
        (SessionPlace.NONE, False, "systemd does not end"),
    ],
)
def test_what_outlives_sessions_needs_no_remedy(place, lingers, words):
    found = lifetime(place, "dev", lingers=lingers)
    assert words in found.found
    assert found.remedy is None


def test_this_process_has_a_place():
    assert lifetime_here().found
