"""Claims of papers: how a file is read, and what runs say of each claim."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from slamhive.base.errors import Forbidden, InvalidInput, NotFound
from slamhive.base.project import project_root
from slamhive.base.settings import Mode
from slamhive.base.strict_yaml import load
from slamhive.documents.claims import ClaimAnswer, ClaimsAnswer, ClaimsFile
from slamhive.documents.limits import StopWhen
from slamhive.documents.submission import Submission
from slamhive.domain.claim import ClaimState
from slamhive.domain.trust import Disturbance, DisturbanceKind, DisturbanceReason
from slamhive.services.claims import badge_svg
from slamhive.services.hive import Hive
from tests.services.gate_world import add_failed, add_good, errors_m, finish
from tests.web import web_world as world

pytestmark = pytest.mark.integration  # scipy takes a second to load

HEAD = "format: 1\nname: paper\ntitle: A paper\nsource: Table 1\n"
ENTRY = "claims:\n  - algorithm: eye-slam-stereo\n    dataset: room\n    states: {ate.rmse: 5.00 cm}\n"


@pytest.fixture(scope="module")
def hive(tmp_path_factory: pytest.TempPathFactory, sqlite_template: Path) -> Iterator[Hive]:
    """With eight good runs of 5 cm at 1000 features, three at 1500, six that failed at 2000, and six noisy at 2500."""
    opened = world.make_hive(tmp_path_factory.mktemp("claims"), template=sqlite_template)
    add_good(opened, errors_m(8, 0.05, 0.01), nFeatures=1000)
    add_good(opened, errors_m(3, 0.05, 0.01), nFeatures=1500)
    add_failed(opened, 6, nFeatures=2000)
    add_good(opened, [0.02, 0.06, 0.03, 0.02, 0.07, 0.03], nFeatures=2500)
    yield opened
    opened.close()


def write(folder: Path, body: str = ENTRY, head: str = HEAD) -> Path:
    path = folder / "claims.yaml"
    path.write_text(head + body)
    return path


def checked(hive: Hive, path: Path) -> ClaimsAnswer:
    return hive.claims.answer(hive.claims.read(path))


def only(hive: Hive, folder: Path, states: str, more: str = "", features: int = 1000) -> ClaimAnswer:
    """The answer about one claim on the runs with so many features."""
    entry = f"claims:\n  - algorithm: eye-slam-stereo\n    dataset: room\n    parameters: {{nFeatures: {features}}}\n"
    (answer,) = checked(hive, write(folder, f"{entry}    states: {{{states}}}\n{more}")).claims
    return answer


def test_a_number_within_the_interval_of_our_runs_holds(hive: Hive, tmp_path: Path):
    answer = only(hive, tmp_path, "ate.rmse: 5.00 cm")
    assert answer.state is ClaimState.HOLDS
    assert answer.about == "eye-slam-stereo on room (nFeatures = 1000)"
    assert answer.value == pytest.approx(5.0, abs=0.05)
    assert answer.unit == "cm"
    assert answer.low is not None
    assert answer.high is not None
    assert answer.low < 5.0 < answer.high
    assert len(answer.runs) == 8


def test_another_number_differs_and_its_ratio_is_told(hive: Hive, tmp_path: Path):
    answer = only(hive, tmp_path, "ate.rmse: 0.025 m")
    assert answer.state is ClaimState.DIFFERS
    assert answer.ratio == pytest.approx(2.0, abs=0.05)
    assert "times the stated number" in answer.words


def test_fewer_printed_digits_allow_more(hive: Hive, tmp_path: Path):
    assert only(hive, tmp_path, "ate.rmse: 0.052 m").state is ClaimState.DIFFERS
    assert only(hive, tmp_path, "ate.rmse: 0.05 m").state is ClaimState.HOLDS


@pytest.mark.parametrize("within", ["5%", "2 mm", "{ate.rmse: 5%, cpu.mean: 1%}"])
def test_a_tolerance_widens_what_holds(hive: Hive, tmp_path: Path, within: str):
    assert only(hive, tmp_path, "ate.rmse: 0.052 m", f"    within: {within}\n").state is ClaimState.HOLDS


def test_a_stated_deviation_widens_it_as_welch_has_it(hive: Hive, tmp_path: Path):
    assert only(hive, tmp_path, "ate.rmse: 0.0520 ± 0.0030 m", "    runs: 5\n").state is ClaimState.HOLDS


def test_the_median_ignores_a_far_run(hive: Hive, tmp_path: Path):
    answer = only(hive, tmp_path, "ate.rmse: 3.0 cm", "    of: median\n", features=2500)
    assert answer.state is not ClaimState.DIFFERS
    assert answer.value == pytest.approx(3.0)


def test_too_few_runs_decide_nothing(hive: Hive, tmp_path: Path):
    answer = only(hive, tmp_path, "ate.rmse: 5.00 cm", features=1500)
    assert (answer.state, answer.lacking) == (ClaimState.UNDECIDED, 2)
    assert answer.words == "3 of 5 runs: 2 more needed"
    assert only(hive, tmp_path, "ate.rmse: 5.00 cm", "    repeats: 3\n", 1500).state is ClaimState.HOLDS


def test_runs_that_vary_too_much_confirm_nothing(hive: Hive, tmp_path: Path):
    answer = only(hive, tmp_path, "ate.rmse: 4 cm", features=2500)
    assert answer.state is ClaimState.UNDECIDED
    assert answer.lacking > 0
    assert "more run needed" in answer.words


def test_runs_that_all_failed_differ_from_any_number(hive: Hive, tmp_path: Path):
    answer = only(hive, tmp_path, "ate.rmse: 5.00 cm", features=2000)
    assert (answer.state, answer.words) == (ClaimState.DIFFERS, "all 6 runs failed: did not end well")
    assert len(answer.failed) == 6


def test_a_run_that_missed_input_on_a_busy_machine_says_nothing(hive: Hive, tmp_path: Path):
    busy = Disturbance(known=True, reasons=(DisturbanceReason(DisturbanceKind.STEAL, "the hypervisor took it"),))
    run_ids = world.add_runs(hive, 6, nFeatures=1800)
    for number, run_id in enumerate(run_ids):
        missed = number < 3
        hive.store.write(lambda t: t.metrics.put(run_id, None, {"frames.dropped_fraction": 0.6 if missed else 0.0}))  # noqa: B023
        finish(hive, run_id, 0.5 if missed else 0.05)
        hive.store.write(lambda t: t.runs.update(run_id, disturbance=busy if missed else None))  # noqa: B023
    answer = only(hive, tmp_path, "ate.rmse: 5.00 cm", "    repeats: 3\n", 1800)
    assert (answer.state, answer.runs) == (ClaimState.HOLDS, tuple(run_ids[3:]))
    assert answer.notes == ("3 runs left out: input was missed on a disturbed machine.",)


def test_only_the_data_that_ran_last_counts(hive: Hive, tmp_path: Path):
    add_good(hive, errors_m(2, 0.5), nFeatures=1600, checksum=f"sha256:{'2' * 64}")
    newest = add_good(hive, errors_m(3, 0.05, 0.01), nFeatures=1600)
    answer = only(hive, tmp_path, "ate.rmse: 5.00 cm", "    repeats: 3\n", 1600)
    assert (answer.state, answer.runs) == (ClaimState.HOLDS, tuple(newest))
    assert answer.notes == ("2 older runs of another version, or on another content of the dataset, left out.",)


def test_a_run_with_little_memory_or_a_rule_that_ends_it_says_nothing(hive: Hive, tmp_path: Path):
    plain = Submission("eye-slam-stereo", "room", {"nFeatures": 1700}, executor="process")
    rule = replace(plain, stop_when=StopWhen(time_s=5.0))
    for limited in (replace(plain, memory_mb=900), replace(plain, cpu_cores=0.5), rule):
        (run,) = hive.runs.submit(limited)
        finish(hive, run.id, 0.5)
    answer = only(hive, tmp_path, "ate.rmse: 5.00 cm", features=1700)
    assert (answer.state, answer.runs) == (ClaimState.UNDECIDED, ())
    assert answer.notes == ("3 runs left out: their CPU, memory or end was limited.",)


def test_a_number_of_another_protocol_leads_to_it(hive: Hive, tmp_path: Path):
    """The claim is the mean error where ours is the RMSE."""
    run_ids = world.add_runs(hive, 2, nFeatures=1900)
    for run_id in run_ids:
        world.finish_run(hive, run_id)
    estimate, truth = world.loop_path(noise_m=0.02)[:, 1:4], world.loop_path()[:, 1:4]
    errors_m = np.linalg.norm(estimate - truth, axis=1)  # alignment moves these little: the noise has no direction
    for run_id in run_ids:
        world.evaluate_run(hive, run_id, float(np.sqrt(np.mean(errors_m**2))))
    stated = f"ate.rmse: {errors_m.mean():.4f} m"
    answer = only(hive, tmp_path, stated, "    repeats: 2\n    within: 1%\n", 1900)
    assert answer.state is ClaimState.DIFFERS
    usual = answer.protocols[0]
    assert usual.key == "ate.mean"
    assert usual.value == pytest.approx(errors_m.mean(), rel=0.02)
    assert "would make it hold on run" in answer.notes[-1]


def test_what_needs_a_dataset_says_how_to_get_it(hive: Hive, tmp_path: Path):
    entry = "  - {{algorithm: eye-slam-stereo, dataset: {}, states: {{ate.rmse: 0.1 m}}}}\n"
    head = f"{HEAD}obtain: {{mine: copy it from the lab}}\n"
    body = "claims:\n" + entry.format("euroc_MH_01_easy") + entry.format("mine")
    (hive.catalogue.project_root / "datasets").mkdir(exist_ok=True)
    link = hive.catalogue.project_root / "datasets" / "catalogue"
    if not link.exists():
        link.symlink_to(project_root() / "datasets" / "catalogue")
    first, second = checked(hive, write(tmp_path, body, head)).claims
    assert first.state is second.state is ClaimState.CANNOT_RUN
    assert first.words == "needs dataset euroc_MH_01_easy; get it with: slamhive dataset fetch euroc/MH_01_easy"
    assert second.words == "needs dataset mine; get it with: copy it from the lab"


def test_a_version_that_is_not_installed_cannot_be_run(hive: Hive, tmp_path: Path):
    answer = only(hive, tmp_path, "ate.rmse: 5.00 cm", "    version: '9.9'\n")
    assert (answer.state, answer.words) == (
        ClaimState.CANNOT_RUN,
        "needs version 9.9 of eye-slam-stereo; version 1.2 is installed",
    )


def test_sensors_that_do_not_fit_cannot_be_run(hive: Hive, tmp_path: Path):
    body = "claims:\n  - {algorithm: beam-odometry, dataset: room, states: {ate.rmse: 0.1 m}}\n"
    (answer,) = checked(hive, write(tmp_path, body)).claims
    assert answer.state is ClaimState.CANNOT_RUN


def test_other_machines_are_named_where_they_matter(hive: Hive, tmp_path: Path):
    answer = only(hive, tmp_path, "cpu.mean: 1.2 cores")
    assert "Test CPU" in " ".join(answer.notes)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("ate.rmse", "ate.rmsee", "line 8: unknown metric 'ate.rmsee'"),
        ("ate.rmse", "ate.sse", "line 8: no direction of ate.sse is better"),
        ("5.00 cm", "5.00 inch", "line 8: ate.rmse: 'inch' is no unit of it"),
        ("5.00 cm", "0.05", "line 8: claims.0.states.ate.rmse: must be text; put it in quotes (found 0.05)"),
        ("5.00 cm", "5.0 ± 0.1 cm", "has a deviation, so it is a mean over two runs or more"),
        ("eye-slam-stereo", "eye-slam-sterio", "line 6: unknown algorithm 'eye-slam-sterio'"),
        ("dataset: room", "dataset: rooom", "line 6: unknown dataset 'rooom'"),
        ("dataset: room", "dataset: room\n    protocol: se33", "unknown protocol 'se33'"),
        ("dataset: room", "dataset: room\n    within: 5 %%", "'5 %%' is no difference"),
        ("dataset: room", "dataset: room\n    repeats: 1", "repeats: must be greater than or equal to 2"),
        ("dataset: room", "dataset: room\n    versoin: 1", "unknown key 'claims.0.versoin'"),
        ("dataset: room", "dataset: room\n    playback_mode: live", "line 8: claims.0.playback_mode"),
        ("source: Table 1\n", "", "the source of ate.rmse is missing"),
        ("name: paper", "name: ../paper", "line 2: name"),
        ("format: 1", "format: 2", "line 1: format"),
        ("5.00 cm", "&a 5.00 cm", "anchors and aliases are not allowed"),
    ],
)
def test_a_mistake_is_one_line_that_names_place_and_value(hive: Hive, tmp_path: Path, old: str, new: str, said: str):
    path = tmp_path / "claims.yaml"
    path.write_text((HEAD + ENTRY).replace(old, new, 1))
    with pytest.raises((InvalidInput, NotFound)) as error:
        hive.claims.read(path)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_the_same_claim_twice_is_a_mistake(hive: Hive, tmp_path: Path):
    with pytest.raises(
        InvalidInput, match=r"line 11: ate.rmse of eye-slam-stereo on room is claimed twice, as in entry 1"
    ):
        hive.claims.read(write(tmp_path, ENTRY + ENTRY.removeprefix("claims:\n")))


def test_an_answer_is_kept_shown_and_removed(hive: Hive, tmp_path: Path):
    answer = checked(hive, write(tmp_path))
    hive.claims.keep(answer)
    assert hive.claims.get("paper").content == answer.content
    assert [found.name for found in hive.claims.all()] == ["paper"]
    hive.claims.remove("paper")
    assert hive.claims.names() == []
    with pytest.raises(NotFound, match="slamhive claims list shows them"):
        hive.claims.remove("paper")


def test_a_claim_is_left_out_where_a_run_behind_it_is_gone(hive: Hive, tmp_path: Path):
    answer = checked(hive, write(tmp_path))
    (claim,) = answer.claims
    other = claim.model_copy(update={"runs": (999_999,)})
    hive.claims.keep(answer.model_copy(update={"claims": (claim, other)}))
    found = hive.claims.get("paper")
    assert (found.claims, found.hidden) == ((claim,), 1)
    hive.claims.remove("paper")


def test_a_view_only_installation_keeps_nothing(hive: Hive, tmp_path: Path):
    check = hive.claims.read(write(tmp_path))
    answer = hive.claims.answer(check)
    closed = Hive(hive.settings.with_values({"mode": Mode.VIEW_ONLY}), hive.store, hive.catalogue.project_root)
    with pytest.raises(Forbidden):
        closed.claims.keep(answer)
    with pytest.raises(Forbidden):
        closed.claims.start(check)


def test_the_missing_runs_are_queued_once(hive: Hive, tmp_path: Path):
    entry = ENTRY.replace("dataset: room", "dataset: room\n    parameters: {nFeatures: 3000}\n    repeats: 3")
    check = hive.claims.read(write(tmp_path, entry))
    work = hive.claims.start(check)
    runs = [hive.runs.get(run_id) for run_id in work.runs]
    assert [run.seed for run in runs] == [0, 1, 2]
    assert {run.parameters["nFeatures"] for run in runs} == {3000}
    assert hive.claims.start(check).runs == work.runs
    for run_id in work.runs:
        hive.runs.cancel(run_id)


def test_a_badge_is_a_picture_without_anything_else():
    words = {
        "#2e7d32": [ClaimState.HOLDS, ClaimState.HOLDS],
        "#b3261e": [ClaimState.HOLDS, ClaimState.DIFFERS],
        "#5f6368": [ClaimState.HOLDS, ClaimState.UNDECIDED],
    }
    for colour, states in words.items():
        svg = badge_svg(states)
        root = ET.fromstring(svg)
        assert colour in svg
        assert {element.tag.rpartition("}")[2] for element in root.iter()} == {"svg", "title", "rect", "g", "text"}
        assert root.attrib["aria-label"] == f"claims: {sum(s is ClaimState.HOLDS for s in states)} of 2 hold"


def test_the_tables_of_measured_results_are_entered_as_they_are_printed():
    entered = ClaimsFile.model_validate(load(project_root() / "docs/examples/claims/results.yaml"))
    keys = {"ate.rmse": 4, "cpu.mean": 5, "ram.max": 6, "latency.median": 7}
    printed = {}
    for part in (project_root() / "docs/results.md").read_text().split("\n## ")[1:3]:
        dataset = part.split("`")[1]
        for row in re.findall(r"^\| `.*$", part, re.MULTILINE):
            cells = [cell.strip() for cell in row.strip("|").split("|")]
            if cells[4] != "–":
                printed[dataset, cells[0].strip("`")] = {key: cells[place] for key, place in keys.items()}
    stated = {
        (entry.dataset, entry.algorithm): {key: text.rpartition(" ")[0] for key, text in entry.states.items()}
        for entry in entered.claims
    }
    assert stated == printed
    assert json.dumps(entered.model_dump(mode="json"))
