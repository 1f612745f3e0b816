"""The page of a run says by what it was held within its limits."""

from __future__ import annotations

from typing import Any

import pytest

from tests.web.web_world import Web

pytestmark = pytest.mark.integration

HELD = {
    "held_by": "the supervisor",
    "processes": "counted by the supervisor",
    "memory": "watched",
    "cpu": "bound to as many cores",
    "end": "stopped, then killed",
    "priority": "supervisor raised by 5",
    "does_not_hold": {"cgroup": "no group <b>can</b> be made"},
}


def page(web: Web, told: Any) -> str:
    folder = web.hive.runs.folder(web.runs["done"])
    record = folder.read_record()
    folder.write_record({**record, "protections": told} if told is not None else record)
    return " ".join(web.client.get(f"/runs/{web.runs['done']}").text.split())


def test_what_held_a_run_is_told_and_why_nothing_stronger_did(web: Web) -> None:
    text = page(web, HELD)
    assert "<dt>Limits enforced by</dt><dd><details><summary>the supervisor</summary>" in text
    assert "<dt>Processes and threads</dt><dd>counted by the supervisor</dd>" in text
    assert "<dt>No cgroup</dt><dd>no group &lt;b&gt;can&lt;/b&gt; be made</dd>" in text


@pytest.mark.parametrize("told", [None, {}, [], "a text", {"does_not_hold": "a text"}])
def test_runs_of_earlier_versions_and_odd_records_say_nothing_of_it(web: Web, told: Any) -> None:
    assert "Limits enforced" not in page(web, told)
