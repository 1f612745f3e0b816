"""Configurations through the services: made, copied, changed, described, grouped, deleted, exported, imported."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from slamhive.base.errors import Conflict, Forbidden, InvalidInput, NotFound, SlamHiveError
from slamhive.base.settings import Mode
from slamhive.documents.submission import Submission
from slamhive.domain.configuration import parse_step
from slamhive.domain.parameters import Value
from slamhive.domain.run import FailureReason, RunState
from slamhive.runtime import config as run_config
from slamhive.services.configurations import ConfigurationChange, Label, configuration_document, parse_conditions
from slamhive.services.hive import Hive, open_hive
from slamhive.services.worker import worker as worker_module
from slamhive.store import ConfigurationFilter
from tests.services.fake_executor import FakeExecutor, write_trajectory
from tests.services.recorded_track import make_recorded_track
from tests.services.tiny_project import ALGORITHM, environment, make_project

pytestmark = pytest.mark.quick

TYPED = """
format: 1
package: typed
title: Every type
version: "1"
upstream: https://example.invalid/typed
licence: GPL-3.0-or-later
citation: none
modes:
  lidar: {title: Every type, setup: lidar, inputs: {points: lidar}, trajectory_role: points}
parameters:
  count: {type: int, default: 3, minimum: 1, maximum: 9, general: features, help: An int.}
  wait_s: {type: float, default: 0.25, unit: s, general: seconds, help: A float.}
  loud: {type: bool, default: true, help: A bool.}
  words: {type: string, default: "a b", help: A string.}
  kind: {type: enum, default: fast, choices: [fast, slow], help: An enum.}
  K: {type: matrix, default: [1, 0, 0.5], help: A matrix.}
"""
EVERY_TYPE: dict[str, Value] = {
    "count": 5,
    "wait_s": 1.0,
    "loud": False,
    "words": "#1: é",
    "kind": "slow",
    "K": (1.0, 2.0),
}


@pytest.fixture
def hive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sqlite_template: Path) -> Iterator[Hive]:
    make_project(tmp_path / "project")
    make_recorded_track(tmp_path / "data")
    shutil.copy(sqlite_template, tmp_path / "data" / "slamhive.db")
    folder = tmp_path / "project" / "algorithms" / "typed"
    (folder / "slamhive").mkdir(parents=True)
    (folder / "slamhive" / "mapping.py").touch()
    (folder / "requirements.txt").touch()
    (folder / "algorithm.yaml").write_text(TYPED)
    for key, value in environment(tmp_path / "project", tmp_path / "data", poll_interval_s="0.01").items():
        monkeypatch.setenv(key, value)
    for name in ("TROUBLE_PAUSE_S", "IDLE_PAUSE_S", "CANCEL_CHECK_S"):
        monkeypatch.setattr(worker_module, name, 0.01)
    opened = open_hive()
    opened.executors.opened["process"] = FakeExecutor(on_start=write_trajectory())
    yield opened
    opened.close()


def typed(**parameters: Value) -> Submission:
    return Submission("typed", "track", parameters)


def edit(hive: Hive, old: str, new: str) -> None:
    """Change the definition of a parameter, as a user does."""
    path = hive.catalogue.project_root / "algorithms" / "typed" / "algorithm.yaml"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def run(hive: Hive, submission: Submission) -> int:
    return hive.runs.submit(replace(submission, evaluate=False))[0].id


# -- made, found, described --------------------------------------------------------------------------------------------


@pytest.mark.integration
def test_identical_configurations_are_one_and_the_user_is_told(hive: Hive):
    first = hive.configurations.create(typed(count="5"), Label("five", "first of all", "mine"))
    again = hive.configurations.create(typed(features=5.0), Label("cinque"))
    run(hive, typed(count=5))
    assert (first.created, first.words) == (True, "configuration 1 (five) is new")
    assert (again.created, again.words) == (False, "the same as configuration 1 (five)")
    assert again.notes == ("it keeps the name 'five'",)
    record = hive.configurations.find("five")
    assert (record.id, record.note, record.groups, record.runs) == (1, "first of all", ("mine",), 1)
    assert hive.configurations.same_as(typed(count=5)) == record
    assert hive.configurations.same_as(typed(count=6)) is None


@pytest.mark.integration
def test_every_type_from_definition_to_store_to_config_yaml_to_search(hive: Hive):
    stored = hive.configurations.create(Submission("typed", "track", {**EVERY_TYPE, "K": "[1, 2]", "loud": "no"}))
    values = stored.record.configuration.parameters
    assert values == EVERY_TYPE
    assert [type(value) for value in values.values()] == [type(value) for value in EVERY_TYPE.values()]
    run_id = run(hive, Submission("typed", "track", EVERY_TYPE))
    hive.worker().run(until_idle=True)
    assert hive.runs.get(run_id).configuration_id == stored.record.id
    config = run_config.load(hive.runs.folder(run_id).config)
    assert config.algorithm_parameters == {**EVERY_TYPE, "K": [1.0, 2.0]}
    assert config.general_parameter == {"save_map": 0, "features": 5, "seconds": 1.0}
    hive.configurations.create(typed())
    conditions = ("count=5", "features>4", "seconds>=1", "loud=false", "words=#1: é", "kind=slow", "K=1, 2")
    for text in conditions:
        page = hive.configurations.page(ConfigurationFilter(conditions=parse_conditions([text])))
        assert [record.id for record in page.records] == [stored.record.id], text
    shown = configuration_document(stored.record).content["parameters"]
    assert shown["count"] == {"value": 5, "type": "int", "unit": "", "general": "features"}
    assert {key: entry["type"] for key, entry in shown.items()} == {
        "count": "int", "wait_s": "float", "loud": "bool", "words": "string", "kind": "enum", "K": "matrix"
    }  # fmt: skip


def test_one_axis_across_algorithms(hive: Hive):
    """``seconds`` is tiny's own key and typed's general name."""
    one = hive.configurations.create(Submission("tiny", "track", {"seconds": 2})).record.id
    two = hive.configurations.create(typed(seconds=2)).record.id
    hive.configurations.create(typed(seconds=3))
    page = hive.configurations.page(ConfigurationFilter(conditions=parse_conditions(["seconds=2"])))
    assert [record.id for record in page.records] == [two, one]


def test_a_name_that_is_taken_stores_nothing(hive: Hive):
    hive.configurations.create(typed(), Label("mine"))
    with pytest.raises(Conflict, match="the name 'mine' belongs to configuration 1"):
        hive.configurations.create(typed(count=4), Label("mine"))
    assert hive.configurations.page().total == 1


@pytest.mark.parametrize("name", ["12", "a\nb", "x" * 65, "\x1b[31m", "a\u202eb"])
def test_names_are_one_line_and_no_number(hive: Hive, name: str):
    with pytest.raises(InvalidInput, match=r"configuration name .* is not allowed"):
        hive.configurations.create(typed(), Label(name))
    with pytest.raises(InvalidInput, match="group name"):
        hive.configurations.create(typed(), Label(group=name))
    with pytest.raises(InvalidInput, match="note"):
        hive.configurations.create(typed(), Label(note="a\x00b"))
    assert hive.configurations.page().total == 0


@pytest.mark.parametrize("text", ["", "count", "=5", "count=", "count~5", "<5"])
def test_a_condition_that_is_none(text: str):
    with pytest.raises(InvalidInput, match="for example features>=1000"):
        parse_conditions([text])


# -- copied and changed ------------------------------------------------------------------------------------------------


@pytest.mark.integration
def test_a_copy_differs_where_it_was_told_to(hive: Hive):
    variant = (parse_step("rate every=2"),)
    original = hive.configurations.create(replace(typed(count=5), variant=variant, playback_rate=2.0), Label("old"))
    copy = hive.configurations.copy(original.record.id, ConfigurationChange(parameters={"features": 6}), Label("new"))
    assert copy.created
    content, before = copy.record.configuration, original.record.configuration
    assert content == replace(before, parameters={**before.parameters, "count": 6})
    assert hive.configurations.get(original.record.id).name == "old"
    same = hive.configurations.copy(original.record.id, ConfigurationChange())
    assert same.words == "the same as configuration 1 (old)"
    bare = hive.configurations.copy(original.record.id, ConfigurationChange(variant=()))
    assert bare.record.configuration.variant == ()


def test_a_copy_for_another_algorithm_takes_what_has_a_name_there(hive: Hive):
    original = hive.configurations.create(typed(seconds=2, count=4))
    copy = hive.configurations.copy(original.record.id, ConfigurationChange(algorithm="tiny"))
    assert copy.record.configuration.parameters == {"seconds": 2.0, "behaviour": "good"}
    assert copy.notes[0] == "count=4 is left out: tiny has no such parameter"


def test_what_nothing_depends_on_is_replaced(hive: Hive):
    old = hive.configurations.create(typed(count=5), Label("mine", "a note", "group")).record.id
    changed = hive.configurations.modify(old, ConfigurationChange(parameters={"count": 6}))
    assert changed.record.id != old
    assert (changed.record.name, changed.record.note, changed.record.groups) == ("mine", "a note", ("group",))
    assert changed.notes == (f"configuration {old} (mine) is gone: nothing depended on it",)
    assert hive.configurations.page().total == 1


def test_what_has_runs_stays_as_it_is(hive: Hive):
    old = hive.configurations.create(typed(count=5), Label("mine")).record
    run(hive, typed(count=5))
    changed = hive.configurations.modify(old.id, ConfigurationChange(parameters={"count": 6}), Label("other"))
    assert changed.notes == ("configuration 1 (mine) stays as it is: it has 1 run",)
    assert (changed.created, changed.record.name) == (True, "other")
    assert hive.configurations.get(old.id).configuration == old.configuration


def test_name_and_note_change_without_a_copy(hive: Hive):
    old = hive.configurations.create(typed(), Label("mine", "x")).record.id
    run(hive, typed())
    changed = hive.configurations.modify(old, ConfigurationChange(), Label("yours", ""))
    assert (changed.record.id, changed.record.name, changed.record.note) == (old, "yours", "")
    assert hive.configurations.modify(old, ConfigurationChange(), Label("")).record.name is None


# -- deleted -----------------------------------------------------------------------------------------------------------


def test_deletion_is_all_or_nothing(hive: Hive):
    free = hive.configurations.create(typed(count=5)).record.id
    run(hive, typed(count=6))
    with pytest.raises(Conflict, match="configuration 2 has 1 run"):
        hive.configurations.delete([free, 2])
    assert hive.configurations.page().total == 2
    hive.configurations.delete([free, free])
    with pytest.raises(NotFound, match="unknown configuration 1"):
        hive.configurations.get(free)


def test_view_only_changes_nothing(hive: Hive, monkeypatch: pytest.MonkeyPatch):
    made = hive.configurations.create(typed()).record.id
    monkeypatch.setenv("SLAMHIVE_MODE", Mode.VIEW_ONLY.value)
    viewing = open_hive()
    try:
        text = viewing.configurations.export_yaml(made)
        for change in (
            lambda c: c.create(typed(count=5)),
            lambda c: c.copy(made, ConfigurationChange()),
            lambda c: c.modify(made, ConfigurationChange()),
            lambda c: c.describe(made, Label("x")),
            lambda c: c.group("g", [made]),
            lambda c: c.delete([made]),
            lambda c: c.import_yaml(text, "x"),
        ):
            with pytest.raises(Forbidden):
                change(viewing.configurations)
    finally:
        viewing.close()
    assert hive.configurations.page().total == 1


# -- YAML --------------------------------------------------------------------------------------------------------------


def test_an_export_comes_back_to_the_same_configuration(hive: Hive):
    steps = (parse_step("rate every=2"), parse_step("fog visibility_m=50 seed=3"))
    original = hive.configurations.create(
        replace(Submission("typed", "track", EVERY_TYPE), variant=steps), Label("a: <b>", "line 1\nline 2")
    )
    text = hive.configurations.export_yaml(original.record.id)
    assert hive.configurations.import_yaml(text, "x.yaml").words == "the same as configuration 1 (a: <b>)"
    hive.configurations.delete([original.record.id])
    back = hive.configurations.import_yaml(text, "x.yaml").record
    assert back.configuration == original.record.configuration
    assert (back.name, back.note) == ("a: <b>", "line 1\nline 2")


def test_a_published_config_yaml_comes_in_with_what_is_not_taken_over(hive: Hive):
    text = (
        "slam-hive-algorithm: typed\nslam-hive-dataset: track\nalgorithm-parameters:\n  count: 4\n  viewer: 0\n"
        "dataset-frequency:\n  /points: 2\ngeneral-parameter:\n  seconds: 2\n"
    )
    stored = hive.configurations.import_yaml(text, "config.yaml", Label("published"))
    assert stored.record.configuration.parameters["count"] == 4
    assert stored.record.configuration.parameters["wait_s"] == 2.0
    assert [step.kind for step in stored.record.configuration.variant] == ["rate"]
    assert stored.notes == ("algorithm-parameters viewer=0 is not taken over: typed has no such parameter",)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("algorithm: typed\ndataset: track\nparameters: {count: many}\n", "x.yaml: parameter count='many' is not"),
        ("algorithm: typed\ndataset: track\nparameters: {count: {a: 1}}\n", "x.yaml: parameters.count"),
        ("algorithm: typed\ndataset: track\nname: [1]\n", "x.yaml: name: must be text"),
        ("algorithm: typed\ndataset: track\nname: '12'\n", "configuration name '12' is not allowed"),
        ("algorithm: typed\ndataset: nowhere\n", "x.yaml: unknown dataset 'nowhere'"),
        ("slam-hive-algorithm: vins-mono\nslam-hive-dataset: track\n", "x.yaml: unknown algorithm 'vins-mono'"),
        ("algorithm: &a typed\ndataset: *a\n", "x.yaml line 1: anchors and aliases are not allowed"),
        ("a: !!python/object:os.system x\n", "x.yaml line 1: the tag"),
        ("a: " + "[" * 50 + "]" * 50, "x.yaml line 1: nested deeper than"),
        ("a: " + "x" * 2_000_001, "x.yaml is larger than"),
        ("algorithm: typed\nalgorithm: tiny\n", "x.yaml line 2: the key 'algorithm' appears twice"),
        ("", "x.yaml: expected keys with values at the top level, found nothing"),
        ("\x00", "x.yaml"),
        ("algorithm: typed\ndataset: track\nvariant: [{step: rate, sensors: [lidar], every: 0}]\n", "x.yaml: step"),
        ("algorithm: typed\ndataset: track\nplayback: {rate: .inf}\n", "x.yaml line 3: playback.rate: inf is"),
    ],
)  # fmt: skip
def test_yaml_that_cannot_be_meant_is_refused_in_one_line(hive: Hive, text: str, message: str):
    with pytest.raises(SlamHiveError) as caught:
        hive.configurations.import_yaml(text, "x.yaml")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert hive.configurations.page().total == 0


# -- edited definitions ------------------------------------------------------------------------------------------------

EDITS = {
    "default": ("default: 3,", "default: 4,"),
    "unit": ("default: 0.25, unit: s", "default: 0.25, unit: ms"),
    "wider": ("maximum: 9", "maximum: 99"),
    "int to float": ("count: {type: int", "count: {type: float"),
    "general name": ("general: features", "general: points"),
}
OUTDATED = {
    "range": ("maximum: 9", "maximum: 4", "count=5 is stored, typed now wants int, 1 to 4"),
    "type": ('{type: string, default: "a b"', "{type: int, default: 1", "words='#1: é' is stored, typed now"),
    "choice": ("choices: [fast, slow]", "choices: [fast]", "kind='slow' is stored, typed now wants one of fast"),
    "removal": ("  loud: {type: bool, default: true, help: A bool.}\n", "", "typed has no parameter 'loud' any more"),
    "addition": ("parameters:\n", "parameters:\n  new: {type: int, default: 1, help: x}\n", "has a new parameter"),
}  # fmt: skip


@pytest.mark.integration
@pytest.mark.parametrize("kind", [*EDITS, *OUTDATED])
def test_no_edit_of_a_definition_changes_what_is_stored(hive: Hive, kind: str):
    run_id = run(hive, Submission("typed", "track", EVERY_TYPE))
    hive.worker().run(until_idle=True)
    before = hive.configurations.get(1)
    edit(hive, *(EDITS.get(kind) or OUTDATED[kind][:2]))
    run(hive, Submission("typed", "track", {"seconds": 9}))
    after = hive.configurations.get(1)
    assert after.configuration == before.configuration
    assert after.configuration.content_hash == before.configuration.content_hash
    assert {key: (entry.type, entry.unit) for key, entry in after.parameters.items()} == {
        key: (entry.type, entry.unit) for key, entry in before.parameters.items()
    }
    assert hive.runs.get(run_id).parameters == EVERY_TYPE
    assert hive.runs.get(run_id).state is RunState.SUCCEEDED


@pytest.mark.integration
@pytest.mark.parametrize("kind", EDITS)
def test_what_still_fits_runs_again_with_what_is_stored(hive: Hive, kind: str):
    first = run(hive, Submission("typed", "track", EVERY_TYPE))
    hive.worker().run(until_idle=True)
    edit(hive, *EDITS[kind])
    again = hive.runs.retry(first)
    hive.worker().run(until_idle=True)
    assert hive.runs.get(again.id).state is RunState.SUCCEEDED
    config = run_config.load(hive.runs.folder(again.id).config)
    assert config.algorithm_parameters == {**EVERY_TYPE, "K": [1.0, 2.0]}
    assert again.configuration_id == hive.runs.get(first).configuration_id


@pytest.mark.parametrize("kind", OUTDATED)
def test_what_no_longer_fits_is_named_before_it_is_queued(hive: Hive, kind: str):
    first = run(hive, Submission("typed", "track", EVERY_TYPE))
    hive.runs.cancel(first)
    old, new, words = OUTDATED[kind]
    edit(hive, old, new)
    with pytest.raises(InvalidInput) as caught:
        hive.runs.retry(first)
    assert words in str(caught.value)
    assert sum(hive.runs.counts().values()) == 1


@pytest.mark.integration
@pytest.mark.parametrize("kind", OUTDATED)
def test_what_no_longer_fits_fails_a_run_that_waited_in_the_same_words(hive: Hive, kind: str):
    waiting = run(hive, Submission("typed", "track", EVERY_TYPE))
    old, new, words = OUTDATED[kind]
    edit(hive, old, new)
    hive.worker().run(until_idle=True)
    failed = hive.runs.get(waiting)
    assert (failed.state, failed.reason) == (RunState.FAILED, FailureReason.PREPROCESS_ERROR)
    assert words in (failed.detail or "")


def test_the_shipped_test_algorithm_has_no_general_names():
    """The axis above is one although only one side declares it."""
    assert "general" not in ALGORITHM
