"""Gates: what a baseline holds, which runs are compared with it, and the answers."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from slamhive.base.errors import Conflict, Forbidden, InvalidInput, NotFound, Unavailable
from slamhive.base.settings import Mode
from slamhive.documents.gate import Baseline, BaselineConfiguration, GateAnswer
from slamhive.documents.record import ConfigurationContent
from slamhive.documents.submission import Submission
from slamhive.domain.configuration import Playback
from slamhive.domain.gate import FAILURES, Answer
from slamhive.domain.protocol import Alignment, Protocol
from slamhive.domain.question import RunBudget
from slamhive.domain.run import RunState
from slamhive.domain.verdict import VerdictKind
from slamhive.services.gates import Gates, Repeats, answer_junit, answer_markdown, repeat_until_decided
from slamhive.services.gates.baselines import find_pair, pairing_key
from slamhive.services.gates.service import Rerun
from slamhive.services.hive import Hive
from slamhive.services.markdown import markdown_html
from slamhive.store import RunRecord
from tests.services.gate_world import add_failed, add_good, errors_m, finish
from tests.web import web_world as world

pytestmark = pytest.mark.integration  # scipy takes a second to load

WHERE = "nFeatures = 1000"
EVALUATED = ("ate.rmse", "ate.per_path", "tracked.path", "tracked_fraction")


@pytest.fixture(scope="module")
def hive(tmp_path_factory: pytest.TempPathFactory, sqlite_template: Path) -> Iterator[Hive]:
    """With the baseline ``main`` of eight runs of one configuration."""
    opened = world.make_hive(tmp_path_factory.mktemp("gate"), template=sqlite_template)
    add_good(opened, errors_m(8))
    opened.gates.baselines.freeze("main", WHERE)
    yield opened
    opened.close()


def answer(hive: Hive, run_ids: Sequence[int], *margins: str, name: str = "main") -> GateAnswer:
    return hive.gates.answer(hive.gates.prepare(name, margins), run_ids)


def answers(found: GateAnswer) -> dict[str, Answer]:
    return {entry.key: entry.answer for entry in found.metrics}


def test_a_baseline_holds_what_a_comparison_needs(hive: Hive):
    held = hive.gates.baselines.get("main")
    (configuration,) = held.configurations
    assert configuration.words == "eye-slam-stereo on room"
    assert configuration.protocol == world.PROTOCOL
    assert configuration.dataset_checksum == f"sha256:{'1' * 64}"
    assert len(configuration.runs) == held.runs == 8
    first = configuration.runs[0]
    assert (first.cpu_model, first.failed) == ("Test CPU", None)
    assert set(first.metrics) == {*EVALUATED, "cpu.mean", "ram.max", "latency.p95"}
    path = hive.settings.data / "baselines" / "main.json"
    assert Baseline.read(json.loads(path.read_text())) == held
    assert [entry.name for entry in hive.gates.baselines.briefs()] == ["main"]


def test_runs_that_did_not_change_pass(hive: Hive):
    found = answer(hive, add_good(hive, errors_m(8, seed=1)))
    assert found.answer is Answer.PASS
    assert set(answers(found)) == {FAILURES, "ate.rmse", "tracked.path", "cpu.mean", "ram.max", "latency.p95"}
    assert found.notes == ()


def test_a_larger_error_is_worse_and_alone_in_that(hive: Hive):
    found = answer(hive, add_good(hive, errors_m(8, 0.06, seed=2)))
    assert found.answer is Answer.WORSE
    assert [key for key, value in answers(found).items() if value is not Answer.PASS] == ["ate.rmse"]
    error = next(entry for entry in found.metrics if entry.key == "ate.rmse")
    assert error.change == pytest.approx(0.2, abs=0.03)
    assert error.change_low is not None
    assert error.change_low > 0.1
    assert "ATE RMSE" in found.words


def test_a_wide_margin_lets_it_pass(hive: Hive):
    assert answer(hive, add_good(hive, errors_m(8, 0.06, seed=3)), "ate.rmse=50%").answer is Answer.PASS


def test_a_few_runs_are_undecided_and_a_note_says_so(hive: Hive):
    found = answer(hive, add_good(hive, [0.05]))
    assert found.answer is Answer.UNDECIDED
    assert "eye-slam-stereo on room has too few runs to decide on its own: 1 run against 8" in found.notes[0]


def test_failed_runs_are_never_dropped(hive: Hive):
    found = answer(hive, [*add_good(hive, errors_m(2, seed=4)), *add_failed(hive, 7)])
    assert found.answer is Answer.WORSE
    assert answers(found)[FAILURES] is Answer.WORSE
    assert answers(found)["ate.rmse"] is not Answer.PASS
    assert len(found.configurations[0].failed) == 7


def test_one_diverged_run_prevents_a_pass(hive: Hive):
    found = answer(hive, add_good(hive, [*errors_m(7, seed=5), 9.0]))
    assert found.answer is Answer.UNDECIDED
    assert answers(found)[FAILURES] is Answer.UNDECIDED
    values = next(entry for entry in found.metrics if entry.key == FAILURES).configurations[0]
    assert (values.baseline, values.candidate) == (0.0, 0.125)


def test_the_runs_of_the_baseline_are_not_compared_with_themselves(hive: Hive):
    own = [run.uid for run in hive.gates.baselines.get("main").configurations[0].runs]
    run_ids = hive.store.read(lambda t: list(t.runs.ids_by_uid(own).values()))
    with pytest.raises(
        InvalidInput, match=r"no run can be compared with baseline main: the baseline holds them \(8 runs"
    ):
        answer(hive, run_ids)


def test_runs_of_another_protocol_are_refused_and_named(hive: Hive):
    run_ids = add_good(hive, [0.05], protocol=Protocol(Alignment.SIM3))
    check = hive.gates.prepare("main")
    assert hive.gates.lacking(check, run_ids) == {world.PROTOCOL: run_ids}
    with pytest.raises(InvalidInput, match=f"run {run_ids[0]} of .* was not evaluated under .*give --evaluate"):
        hive.gates.answer(check, run_ids)


def test_another_content_of_the_dataset_is_refused(hive: Hive):
    run_ids = add_good(hive, errors_m(2), checksum=f"sha256:{'2' * 64}")
    with pytest.raises(InvalidInput, match="dataset room differs from that of the baseline"):
        answer(hive, run_ids)


def test_another_processor_is_noted(hive: Hive):
    found = answer(hive, add_good(hive, errors_m(8, seed=6), cpu="Faster CPU"))
    assert found.notes == ("CPU, memory and latency are of different processors: Faster CPU; the baseline Test CPU.",)


def test_a_parameter_that_differs_is_named_and_can_be_ignored(hive: Hive):
    run_ids = add_good(hive, errors_m(8, seed=7), nFeatures=1500)
    with pytest.raises(InvalidInput, match=r"differs from the baseline in nFeatures \(1000, here 1500\)"):
        answer(hive, run_ids)
    check = hive.gates.prepare("main", ignored=["nFeatures"])
    assert hive.gates.answer(check, run_ids).answer is Answer.PASS


def test_a_configuration_without_runs_prevents_a_pass_unless_it_may_lack(hive: Hive):
    add_good(hive, errors_m(8, seed=8), nFeatures=2000)
    add_good(hive, errors_m(8, seed=9), nFeatures=3000)
    hive.gates.baselines.freeze("two", "nFeatures in (2000, 3000)")
    run_ids = add_good(hive, errors_m(8, seed=10), nFeatures=2000)
    found = answer(hive, run_ids, name="two")
    assert (found.answer, found.missing) == (Answer.UNDECIDED, ("eye-slam-stereo on room, nFeatures=3000",))
    check = hive.gates.prepare("two", partial=True)
    assert hive.gates.answer(check, run_ids).answer is Answer.PASS


def test_a_baseline_counts_failed_runs_and_leaves_out_what_has_not_ended(hive: Hive):
    add_good(hive, errors_m(3, seed=11), nFeatures=4000)
    add_failed(hive, 2, nFeatures=4000)
    world.add_runs(hive, 1, nFeatures=4000)
    frozen = hive.gates.baselines.freeze("some", "nFeatures = 4000")
    assert (frozen.baseline.runs, frozen.baseline.failed, frozen.left_out) == (5, 2, 1)
    assert [run.failed for run in frozen.baseline.configurations[0].runs].count(VerdictKind.ENDED_BADLY) == 2


def test_a_baseline_of_two_protocols_is_refused_until_one_is_named(hive: Hive):
    add_good(hive, errors_m(2), nFeatures=5000)
    add_good(hive, errors_m(2), nFeatures=5000, protocol=Protocol(Alignment.SIM3))
    with pytest.raises(InvalidInput) as refused:
        hive.gates.baselines.freeze("mixed", "nFeatures = 5000")
    assert refused.value.message == "eye-slam-stereo on room: 2 runs use SE(3), 2 Sim(3): not comparable"
    fingerprint = Protocol(Alignment.SIM3).fingerprint
    command = f"slamhive evaluate RUNS --protocol {fingerprint} --current"
    assert refused.value.remedy == f"choose one with --protocol, or evaluate all under Sim(3): {command}"
    frozen = hive.gates.baselines.freeze("mixed", "nFeatures = 5000", world.PROTOCOL.fingerprint)
    assert (frozen.baseline.runs, frozen.left_out) == (2, 2)


def test_a_baseline_needs_a_run_that_works(hive: Hive):
    add_failed(hive, 2, nFeatures=6000)
    with pytest.raises(InvalidInput, match="all runs of eye-slam-stereo on room failed"):
        hive.gates.baselines.freeze("broken", "nFeatures = 6000")
    add_good(hive, [9.0], nFeatures=6000)  # it diverged
    with pytest.raises(InvalidInput, match="a baseline needs a good one"):
        hive.gates.baselines.freeze("broken", "nFeatures = 6000")
    with pytest.raises(InvalidInput, match="none of the 0 runs that match has ended"):
        hive.gates.baselines.freeze("broken", "nFeatures = 7000")
    assert not (hive.settings.baselines_folder / "broken.json").exists()


def test_names_are_taken_once_and_removed(hive: Hive, tmp_path: Path):
    with pytest.raises(Conflict, match="baseline main exists already"):
        hive.gates.baselines.freeze("main", WHERE)
    hive.gates.baselines.export("main", tmp_path / "kept.json")
    assert hive.gates.baselines.get(str(tmp_path / "kept.json")) == hive.gates.baselines.get("main")
    with pytest.raises(NotFound, match="unknown baseline 'mian'; did you mean 'main'"):
        hive.gates.baselines.get("mian")
    add_good(hive, errors_m(1), nFeatures=8000)
    hive.gates.baselines.freeze("other", "nFeatures = 8000")
    hive.gates.baselines.remove("other")
    with pytest.raises(NotFound, match="unknown baseline 'other'"):
        hive.gates.baselines.remove("other")
    for name in ("../main", "a/b", "x.json"):
        with pytest.raises(InvalidInput):
            hive.gates.baselines.freeze(name, WHERE)


@pytest.mark.parametrize("damage", ["", "[]", "{}", '{"format": 2}', '{"name": NaN}', "\x00", "cut"])
def test_a_file_that_is_no_baseline_is_refused_in_one_line(hive: Hive, tmp_path: Path, damage: str):
    path = tmp_path / "baseline.json"
    hive.gates.baselines.export("main", path)
    path.write_text(path.read_text()[:5000] if damage == "cut" else damage)
    with pytest.raises(InvalidInput, match=r"baseline\.json"):
        hive.gates.baselines.get(str(path))


def test_names_in_a_file_from_elsewhere_are_shown_as_text(hive: Hive, tmp_path: Path):
    file = hive.gates.baselines.get("main").content
    file["configurations"].append({**file["configurations"][0], "algorithm": "<script>|`x`"})
    (tmp_path / "baseline.json").write_text(json.dumps({**file, "name": "<b>\n# more"}))
    check = hive.gates.prepare(str(tmp_path / "baseline.json"))
    found = hive.gates.answer(check, add_good(hive, errors_m(2, seed=15)))
    page = markdown_html(answer_markdown(found))
    assert "&lt;script&gt;|`x` on room" in page
    assert ("<b>" in page, page.count("<h")) == (False, 1)
    assert "<script>" not in answer_junit(found)


def test_view_only_changes_nothing(hive: Hive):
    viewer = Hive(hive.settings.with_values({"mode": Mode.VIEW_ONLY}), hive.store, hive.project_root)
    with pytest.raises(Forbidden):
        viewer.gates.baselines.freeze("new", WHERE)
    with pytest.raises(Forbidden):
        viewer.gates.baselines.remove("main")
    assert viewer.gates.baselines.get("main").runs == 8


class Started(Gates):
    """Gates whose runs end at once, with the errors of a list."""

    def __init__(self, hive: Hive, errors: Sequence[float]) -> None:
        super().__init__(hive.settings, hive.store, hive.searches, hive.catalogue, hive.configurations, hive.runs)
        self.asked: list[tuple[int, int]] = []
        self._hive = hive
        self._errors = iter(errors)

    def start(self, reruns: Sequence[Rerun], repeats: int, seed: int) -> list[int]:
        self.asked.append((repeats, seed))
        return world.add_runs(self._hive, repeats * len(reruns))

    def work(self, run_ids: Sequence[int]) -> None:
        for run_id in run_ids:
            finish(self._hive, run_id, next(self._errors))


def repeated(hive: Hive, errors: Sequence[float], repeats: Repeats) -> tuple[GateAnswer, list[tuple[int, int]]]:
    gates = Started(hive, errors)
    check = gates.prepare("main", ["cpu.mean=off", "ram.max=off", "latency.p95=off"])
    return repeat_until_decided(gates, check, ["eye-slam-stereo"], repeats, gates.work), gates.asked


def test_repeats_double_until_the_answer_is_known(hive: Hive):
    found, asked = repeated(hive, errors_m(20, seed=12), Repeats(1, RunBudget(runs=20)))
    assert asked == [(1, 0), (1, 1), (2, 2)]
    assert (found.answer, found.looks, found.significance) == (Answer.PASS, 3, 0.05 / 8)


def test_a_spent_budget_ends_undecided(hive: Hive):
    found, asked = repeated(hive, errors_m(20, seed=13), Repeats(1, RunBudget(runs=2)))
    assert asked == [(1, 0), (1, 1)]
    assert found.answer is Answer.UNDECIDED
    assert found.notes[-1] == "The budget of 2 runs is spent: 2 runs."


def test_without_a_budget_there_is_one_look_with_the_whole_significance(hive: Hive):
    found, asked = repeated(hive, errors_m(4, seed=14), Repeats(4))
    assert asked == [(4, 0)]
    assert (found.answer, found.significance) == (Answer.PASS, 0.05)


def test_a_budget_that_is_too_small_is_refused_before_anything_runs(hive: Hive):
    gates = Started(hive, [])
    with pytest.raises(InvalidInput, match="5 repeats of 1 configuration are 5 runs; the budget is 4 runs"):
        repeat_until_decided(
            gates, gates.prepare("main"), ["eye-slam-stereo"], Repeats(5, RunBudget(runs=4)), gates.work
        )
    with pytest.raises(NotFound, match="unknown algorithm of baseline main 'eye-slam-mono'"):
        gates.reruns(gates.prepare("main"), ["eye-slam-mono"])
    with pytest.raises(InvalidInput, match="named with two versions"):
        gates.reruns(gates.prepare("main"), ["eye-slam-stereo@1", "eye-slam-stereo@2"])
    assert gates.asked == []


def test_runs_are_cancelled_if_not_all_can_be_queued(hive: Hive, monkeypatch: pytest.MonkeyPatch):
    queued: list[int] = []

    def submit(submission: Submission, _protocol: Protocol) -> tuple[RunRecord, ...]:
        if queued:
            raise Unavailable("the disk is full")
        queued.extend(world.add_runs(hive, submission.repeat))
        return tuple(map(hive.runs.get, queued))

    monkeypatch.setattr(hive.runs, "submit", submit)
    (rerun,) = hive.gates.reruns(hive.gates.prepare("main"), ["eye-slam-stereo"])
    with pytest.raises(Unavailable, match="the disk is full"):
        hive.gates.start([rerun, rerun], 2, 0)
    assert [hive.runs.get(run_id).state for run_id in queued] == [RunState.CANCELLED] * 2


def content(**changes: object) -> ConfigurationContent:
    values = {"algorithm": "a", "dataset": "d", "parameters": {"x": 1, "y": 2.0}, "playback": Playback()}
    return ConfigurationContent.model_validate({**values, **changes})


def held(hive: Hive, **changes: object) -> BaselineConfiguration:
    (stored,) = hive.gates.baselines.get("main").configurations
    return stored.model_copy(update=dict(content(**changes)))


def test_the_version_of_the_package_does_not_separate_configurations(hive: Hive):
    assert pairing_key(content(version=1)) == pairing_key(content(version=2))
    assert find_pair([held(hive)], content(version=3)) == 0


def test_new_and_removed_parameters_do_not_separate_configurations(hive: Hive):
    assert find_pair([held(hive)], content(parameters={"x": 1, "y": 2.0, "new": 5})) == 0
    assert find_pair([held(hive)], content(parameters={"x": 1})) == 0


def test_a_run_without_a_counterpart_says_why(hive: Hive):
    both = [held(hive), held(hive, parameters={"x": 1, "y": 3.0})]
    assert find_pair(both, content(parameters={"x": 1})) == "fits 2 configurations of the baseline"
    assert find_pair(both, content(dataset="other")) == "no such configuration is in the baseline"
    assert find_pair(both, content(parameters={"x": 9, "y": 3.0})) == "differs from the baseline in x (1, here 9)"
