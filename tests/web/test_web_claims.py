"""Claims on pages, as a badge, over the web API, and in a static site."""

from __future__ import annotations

from base64 import b64encode
from typing import Any

import pytest

from slamhive.documents.claims import ClaimAnswer, ClaimProtocol, ClaimsAnswer, ClaimsDocument
from slamhive.domain.claim import ClaimedStatistic, ClaimState
from slamhive.services.hive import Hive
from slamhive.web.static_site import SiteRequest, StaticSite
from tests.web import web_world as world
from tests.web.web_world import Web

pytestmark = pytest.mark.quick


def one_of(state: ClaimState, **more: Any) -> ClaimAnswer:
    """An answer about a claim."""
    about = {"about": "eye-slam-stereo on room", "algorithm": "eye-slam-stereo", "dataset": "room", "unit": "cm"}
    claim = {"metric": "ate.rmse", "label": "ATE RMSE", "stated": "5.0 cm", "statistic": ClaimedStatistic.MEAN}
    said = {"source": f"Table 1 {world.HOSTILE}", "protocol": "default", "state": state, "words": "5.1 cm over 5 runs"}
    return ClaimAnswer.model_validate({**about, **claim, **said, **more})


def keep_claims(hive: Hive) -> ClaimsAnswer:
    """Claims in each state, kept for the pages; the first rests on runs."""
    matches = (ClaimProtocol(words="Sim(3), 10 ms", preset="evo", key="ate.rmse", value=5.02),)
    measured: dict[str, Any] = {"value": 5.1, "std": 0.02, "low": 5.0, "high": 5.2, "ratio": 1.02}
    claims = (
        one_of(ClaimState.HOLDS, **measured, runs=(world.RUNS["done"], world.RUNS["failed"]), failed=(3,)),
        one_of(ClaimState.DIFFERS, **measured, protocols=matches, notes=("1 protocol of 900 would make it hold.",)),
        one_of(ClaimState.UNDECIDED, lacking=3),
        one_of(ClaimState.CANNOT_RUN, words="needs dataset euroc_MH_01_easy"),
    )
    answer = ClaimsAnswer(
        name="paper",
        title=f"A paper {world.HOSTILE}",
        words="1 of 4 hold",
        checked_at=world.NOW,
        software="1.0",
        claims=claims,
    )
    hive.claims.keep(answer)
    return answer


def test_there_is_no_entry_without_claims(shown: Web):
    assert "/claims" not in shown.client.get("/").text
    assert "slamhive claims check FILE" in shown.client.get("/claims").text
    assert shown.client.get("/claims/paper").status_code == 404


def test_pages_show_each_answer_and_hostile_text_stays_text(web: Web):
    keep_claims(web.hive)
    assert 'href="/claims"' in web.client.get("/").text
    assert "1 of 4 hold" in web.client.get("/claims").text
    page = web.client.get("/claims/paper").text
    assert world.HOSTILE not in page
    assert 'src="/claims/paper/badge.svg" alt="claims: 1 of 4 hold"' in page
    assert '<a href="/runs/1">1</a>, <a href="/runs/3" title="failed">3</a>' in page
    for text in ("5.10 ± 0.02 cm", "differs", "cannot be run", "ate.rmse is 5.02 cm under Sim(3), 10 ms (as evo)"):
        assert text in page


def test_the_badge_is_a_picture(web: Web):
    keep_claims(web.hive)
    answer = web.client.get("/claims/paper/badge.svg")
    assert answer.mimetype == "image/svg+xml"
    assert "claims: 1 of 4 hold" in answer.text


def test_the_api_answers_what_was_kept(web: Web):
    kept = keep_claims(web.hive)
    found = ClaimsDocument.read(web.client.get("/api/v1/claims").get_json())
    assert [answer.content for answer in found.files] == [kept.content]


def test_a_static_site_has_the_claims_and_their_badge(web: Web):
    keep_claims(web.hive)
    folder = web.hive.settings.data / "site"
    StaticSite(web.hive, SiteRequest(folder)).write(lambda _done, _total: None)
    assert '<a href="claims/paper.html">' in (folder / "index.html").read_text()
    page = (folder / "claims" / "paper.html").read_text()
    assert world.HOSTILE not in page
    assert '<a href="../runs/1.html">1</a>' in page
    badge = (folder / "claims" / "paper.svg").read_text()
    assert "claims: 1 of 4 hold" in badge
    assert "img-src data:" in page, "so the picture is in the page itself"
    assert f'src="data:image/svg+xml;base64,{b64encode(badge.encode()).decode()}"' in page
