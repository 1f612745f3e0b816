"""A run's page: figures by protocol, the one that is shown elsewhere, and the way published tools count."""

from __future__ import annotations

from datetime import timedelta

import pytest

from slamhive.domain.protocol import Alignment, Protocol
from slamhive.evaluation.job import RESULT_FILE, EvaluationResult, result_to_json
from slamhive.evaluation.presets import PRESETS
from slamhive.store import Lease, Transaction
from tests.web.test_web_actions import send
from tests.web.web_world import NOW, PROTOCOL, Web

pytestmark = pytest.mark.integration

OTHER = Protocol(Alignment.NONE, time_offset_s=0.25)


@pytest.fixture
def twice(web: Web) -> int:
    """A run with figures under two protocols, the first of them current."""
    run_id = web.runs["done"]
    figures = {"ate.rmse": 7.125, "segment.translation": 1.5, "segment.count": 3271.0}
    result = EvaluationResult(str(run_id), OTHER.fingerprint, None, figures, 400, 398, "evo 1.0")

    def work(transaction: Transaction) -> None:
        (evaluation_id,) = transaction.evaluations.queue([run_id], OTHER, NOW)
        transaction.evaluations.claim(Lease("test", NOW, 30.0), runs=[run_id])
        transaction.evaluations.finish(evaluation_id, "test", result, NOW + timedelta(seconds=9))

    web.hive.store.write(work)
    return run_id


def test_the_current_protocol_is_shown_and_another_on_request(web: Web, twice: int) -> None:
    text = web.client.get(f"/runs/{twice}").text
    assert "Evaluated under 2 protocols" in text
    assert f"({PROTOCOL.fingerprint}, current)" in text
    assert "7.125" not in text
    text = web.client.get(f"/runs/{twice}?protocol={OTHER.fingerprint}").text
    assert f"Accuracy: {OTHER.label} (protocol {OTHER.fingerprint})" in text
    assert "time offset +0.25 s" in OTHER.label
    assert "7.125" in text
    assert "3,271 segments" in text, "a mean over segments stands beside their number"
    assert "Segment count" not in text, "which has no row of its own"
    assert "Make this the current protocol" in text
    assert f"({PROTOCOL.fingerprint}, current)" in web.client.get(f"/runs/{twice}?protocol=%3Cscript%3E").text


def test_what_is_missing_for_one_reason_is_told_once(web: Web, twice: int) -> None:
    reason = "the protocol takes a pose for every one of the ground truth"
    missing = {"kitti.translation": reason, "kitti.rotation": reason, "drift.end": "no pause"}
    folder = web.hive.runs.folder(twice).evaluation(OTHER.fingerprint)
    folder.mkdir(parents=True, exist_ok=True)
    result = EvaluationResult(str(twice), OTHER.fingerprint, None, {"ate.rmse": 7.125}, 4, 4, "evo 1.0", missing)
    (folder / RESULT_FILE).write_text(result_to_json(result))
    text = web.client.get(f"/runs/{twice}?protocol={OTHER.fingerprint}").text
    assert "3 metrics missing, and why" in text
    assert text.count(reason) == 1
    assert "kitti.translation, kitti.rotation" in text


def test_the_current_protocol_is_changed_by_post(web: Web, twice: int) -> None:
    assert send(web, f"/runs/{twice}/protocol", fingerprint=OTHER.fingerprint).status_code == 303
    assert (web.hive.runs.get(twice).metrics or {})["ate.rmse"] == 7.125
    assert f"({OTHER.fingerprint}, current)" in web.client.get(f"/runs/{twice}").text
    assert web.client.get(f"/runs/{twice}/protocol").status_code == 405
    assert send(web, f"/runs/{twice}/protocol", fingerprint="<b>").status_code == 404
    assert send(web, f"/runs/{web.runs['bare']}/protocol", fingerprint=OTHER.fingerprint).status_code == 409
    assert (web.hive.runs.get(twice).metrics or {})["ate.rmse"] == 7.125


def test_a_run_is_evaluated_as_every_tool_counts(web: Web) -> None:
    run_id = web.runs["done"]
    text = web.client.get(f"/runs/{run_id}").text
    for _, preset in PRESETS:
        assert preset.title in text
    assert f"Compute for {len(PRESETS.names())} tools" in text
    assert send(web, f"/runs/{run_id}/compare").status_code == 303
    queued = [entry for entry in web.hive.evaluations.of_run(run_id) if entry.state == "queued"]
    assert {entry.protocol.fingerprint for entry in queued} == {preset.protocol.fingerprint for _, preset in PRESETS}
    assert "evaluation queued" in web.client.get(f"/runs/{run_id}").text
    assert send(web, f"/runs/{web.runs['failed']}/compare").status_code == 409


def test_evaluation_under_a_named_protocol_by_page_and_api(web: Web) -> None:
    run_id = web.runs["done"]
    assert send(web, f"/runs/{run_id}/evaluate", protocol="tum").status_code == 303
    assert web.hive.evaluations.of_run(run_id)[-1].protocol == PRESETS.get("tum").protocol
    headers = {"X-SLAM-Hive": "1"}
    body = {"runs": [run_id], "protocol": "evo"}
    assert web.client.post("/api/v1/evaluations", json=body, headers=headers).status_code == 202
    assert web.hive.evaluations.of_run(run_id)[-1].protocol == PRESETS.get("evo").protocol
    both = web.client.post("/api/v1/evaluations", json={**body, "alignment": "se3"}, headers=headers)
    assert both.status_code == 400
    unknown = web.client.post("/api/v1/evaluations", json={"runs": [run_id], "protocol": "evvo"}, headers=headers)
    assert unknown.status_code == 404
    assert "did you mean 'evo'" in unknown.text.replace("\\u0027", "'")
