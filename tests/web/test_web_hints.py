"""Hints at common mistakes: on the page of a run and in the API, with their remedies."""

from __future__ import annotations

from dataclasses import replace

import pytest

from slamhive.domain.verdict import Hint
from slamhive.evaluation.job import RESULT_FILE, EvaluationResult, result_to_json
from tests.web.web_world import Web

pytestmark = pytest.mark.integration

HINT = Hint("quaternion_order", "The quaternions seem to be <mixed up>: 144 deg.", "write qx qy qz qw")


@pytest.fixture
def hinted(web: Web) -> Web:
    put(web, HINT)
    return web


def put(web: Web, *hints: Hint) -> None:
    run = web.hive.runs.get(web.runs["done"])
    assert run.protocol is not None
    result = EvaluationResult("1", run.protocol.fingerprint, None, {"ate.rmse": 0.1}, 400, 398, "evo 1.0")
    path = web.hive.runs.folder(run.id).evaluation(run.protocol.fingerprint) / RESULT_FILE
    path.write_text(result_to_json(replace(result, hints=hints)))


def test_the_page_of_a_run_tells_mistake_and_remedy(hinted: Web) -> None:
    text = " ".join(hinted.client.get(f"/runs/{hinted.runs['done']}").text.split())
    assert 'data-hint="quaternion_order"><strong>Hint.</strong>' in text
    assert "The quaternions seem to be &lt;mixed up&gt;: 144 deg." in text
    assert "<strong>Remedy:</strong> write qx qy qz qw.</p>" in text


def test_the_api_tells_it_with_the_evaluation(hinted: Web) -> None:
    (evaluation,) = hinted.client.get(f"/api/v1/runs/{hinted.runs['done']}").get_json()["evaluations"]
    assert evaluation["hints"] == [{"key": HINT.key, "sentence": HINT.sentence, "remedy": HINT.remedy}]


def test_a_run_without_hints_is_told_nothing(web: Web) -> None:
    for text in ("{}", "[]", '{"hints": 3}'):
        run = web.hive.runs.get(web.runs["done"])
        assert run.protocol is not None
        (web.hive.runs.folder(run.id).evaluation(run.protocol.fingerprint) / RESULT_FILE).write_text(text)
        assert "<strong>Hint.</strong>" not in web.client.get(f"/runs/{run.id}").text
        (evaluation,) = web.client.get(f"/api/v1/runs/{run.id}").get_json()["evaluations"]
        assert evaluation["hints"] == []
