"""Runs that were measured on a disturbed machine: marked, explained and found on pages and in JSON."""

from __future__ import annotations

import pytest

from slamhive.domain.trust import Disturbance, DisturbanceKind, DisturbanceReason
from tests.web.web_world import Web

pytestmark = pytest.mark.integration

WORDS = "other processes used more than 0.5 of 2 cores for 80 % of the run (1.4 on average)"
BUSY = Disturbance(known=True, reasons=(DisturbanceReason(DisturbanceKind.OTHERS, WORDS),))
BADGE = f'<span class="state trust-limited" title="measured on a disturbed machine: {WORDS}">doubtful</span>'


@pytest.fixture
def marked(web: Web) -> Web:
    """The first run was disturbed, the second was not, of the failed one nothing is known."""
    put(web, "done", BUSY)
    put(web, "bare", Disturbance(known=True, not_measured=("CPU frequency: there is no file",)))
    return web


def put(web: Web, name: str, found: Disturbance) -> None:
    web.hive.store.write(lambda t: t.runs.update(web.runs[name], disturbance=found))


def page(web: Web, address: str) -> str:
    return " ".join(web.client.get(address).text.split())


def test_the_page_of_a_run_says_why_and_what_to_do(marked: Web) -> None:
    text = page(marked, f"/runs/{marked.runs['done']}")
    assert BADGE in text
    assert f"Measured on a disturbed machine: {WORDS}." in text
    assert "Stop other programs and run it again." in text
    assert "dropped frames and errors do too, because playback was in real time" in text


def test_the_page_of_a_quiet_run_says_so_and_what_is_missing(marked: Web) -> None:
    text = page(marked, f"/runs/{marked.runs['bare']}")
    assert "trust-limited" not in text
    assert '<dd title="CPU frequency: there is no file">undisturbed (not recorded: CPU frequency)</dd>' in text


def test_an_old_run_is_unknown_not_undisturbed(marked: Web) -> None:
    text = page(marked, f"/runs/{marked.runs['failed']}")
    assert "disturbance not recorded" in text
    assert "undisturbed" not in text


def test_a_run_that_was_not_watched_says_why_that_is_not_known(marked: Web) -> None:
    put(marked, "failed", Disturbance(known=False, not_measured=("the machine was not watched", "and more")))
    text = page(marked, f"/runs/{marked.runs['failed']}")
    assert "disturbance unknown: the machine was not watched</dd>" in text


def test_lists_mark_runs_and_count_them_in_groups(marked: Web) -> None:
    assert page(marked, "/runs").count(BADGE) == 1
    assert BADGE in page(marked, "/")
    rows = marked.client.get("/searches/export.json?group=configuration").get_json()
    assert sum(row["disturbed"] for row in {row["configuration"]: row for row in rows}.values()) == 1
    assert '<td title="Measured on a disturbed machine; included in the means">1</td>' in page(
        marked, "/runs?group=configuration"
    )


def test_the_form_finds_them(marked: Web) -> None:
    text = page(marked, "/runs?disturbed=yes&columns=id,disturbed")
    assert '<li class="chip"><code>disturbed = yes</code>' in text
    assert f'title="{WORDS}"><span class="clip">load of others</span>' in text
    assert [row["id"] for row in marked.client.get("/searches/export.json?where=disturbed = no").get_json()] == [
        marked.runs["bare"]
    ]
    rows = marked.client.get("/searches/export.json?columns=id,disturbed").get_json()
    assert {row["id"]: row["disturbed"] for row in rows} == {
        number: {"done": "yes", "bare": "no"}.get(name) for name, number in marked.runs.items()
    }


def test_json_has_the_reasons(marked: Web) -> None:
    found = marked.client.get(f"/api/v1/runs/{marked.runs['done']}").get_json()["disturbance"]
    assert found == {
        "disturbed": True,
        "reasons": [{"kind": "others", "words": WORDS}],
        "not_measured": [],
    }
    assert marked.client.get(f"/api/v1/runs/{marked.runs['failed']}").get_json()["disturbance"] is None


def test_a_run_that_dropped_most_frames_does_not_look_good(marked: Web) -> None:
    run_id = marked.runs["bare"]
    measured = {"frames.dropped_fraction": 0.79, "cpu.limit_used": 0.99}
    marked.hive.store.write(lambda t: t.metrics.put(run_id, None, measured))
    text = page(marked, f"/runs/{run_id}")
    assert '<span class="state outcome-unjudged">not evaluated</span> <span class="state trust-low"' in text
    assert "<strong>Very doubtful.</strong>" in text
    assert "The algorithm was too slow for 79 % of the frames, which were dropped. Give it more CPU cores" in text
    assert "<li>The run used 99 % of the CPU time that its limit allows. Raise the limit of CPU cores.</li>" in text
    found = marked.client.get("/searches/export.json?where=trust = low&columns=id,trust").get_json()
    assert found == [{"id": run_id, "trust": "low"}]
    assert page(marked, "/runs?trust=low&columns=id,trust").count('">very doubtful</span>') == 1
    assert page(marked, "/runs?trust=low").count('">very doubtful</span>') == 1


def test_json_has_the_trust_with_reasons(marked: Web) -> None:
    found = marked.client.get(f"/api/v1/runs/{marked.runs['done']}").get_json()["trust"]
    (reason,) = found["reasons"]
    assert (found["level"], found["doubt"]) == ("limited", "doubtful")
    assert (reason["kind"], reason["level"]) == ("disturbed", "limited")
    assert reason["remedy"] == "stop other programs and run it again"
    unknown = marked.client.get(f"/api/v1/runs/{marked.runs['bare']}").get_json()["trust"]
    assert unknown == {"level": None, "doubt": "", "reasons": [], "not_measured": ["dropped frames were not counted"]}
    assert marked.client.get(f"/api/v1/runs/{marked.runs['queued']}").get_json()["trust"] is None
