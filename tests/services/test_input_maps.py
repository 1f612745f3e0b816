"""The map of one run as an input of another: found, refused in one line, recorded, part of the configuration."""

from __future__ import annotations

import pytest
from click.testing import CliRunner

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.cli import main
from slamhive.documents.submission import Submission
from slamhive.domain.run import FailureReason, RunState
from slamhive.executors.spec import RunSpec
from slamhive.filters.words import matching
from slamhive.recordings.staging import checksum
from slamhive.services.experiments.views import ExperimentSource
from slamhive.services.hive import Hive, open_hive
from slamhive.services.reindex import reindex
from tests.services.fake_executor import FakeExecutor, write_trajectory
from tests.services.tiny_project import make_dataset

pytestmark = pytest.mark.integration

OTHER = """
  other:
    title: Takes maps too
    setup: lidar
    inputs: {points: lidar}
    trajectory_role: points
    map_input: true
  mapless:
    title: Takes no maps
    setup: lidar
    inputs: {points: lidar}
    trajectory_role: points
parameters:
"""


def leave_map(spec: RunSpec) -> None:
    write_trajectory()(spec)
    result = spec.output("result").destination
    if not any(entry.name == "map" for entry in spec.inputs):
        (result / "session.osa").write_bytes(b"atlas")
    else:
        counts = '{"first_frame_s": 100.0, "localised_at_s": 102.5, "frames": 8, "frames_localised": 6}'
        (result / "localisation.json").write_text(counts)


@pytest.fixture
def engine(hive: Hive) -> FakeExecutor:
    yaml = hive.catalogue.package("tiny").folder / "algorithm.yaml"
    text = yaml.read_text().replace("modes:\n", "map_output: session.osa\nmodes:\n")
    text = text.replace("    trajectory_role: points\n", "    trajectory_role: points\n    map_input: true\n")
    yaml.write_text(text.replace("parameters:\n", OTHER.lstrip("\n"), 1))
    found = FakeExecutor(on_start=leave_map)
    hive.executors.opened = {"process": found}
    return found


def run(hive: Hive, algorithm: str = "tiny-lidar", dataset: str = "track", **changes) -> int:
    (submitted,) = hive.runs.submit(Submission(algorithm, dataset, evaluate=False, **changes))
    hive.worker().run(until_idle=True)
    return submitted.id


def test_a_run_starts_with_the_map_of_another(hive: Hive, engine: FakeExecutor) -> None:
    first = run(hive)
    second = run(hive, map=str(first))
    path = hive.runs.folder(first).result / "session.osa"
    (entry,) = [entry for entry in engine.starts[1].inputs if entry.name == "map"]
    assert (entry.source, entry.target, entry.content) == (path, "/slamhive/map/session.osa", checksum(path))
    assert not entry.own_copy
    assert engine.starts[1].environment["SLAMHIVE_MAP"] == entry.target
    record, uid = hive.runs.record(second), hive.runs.get(first).uid
    assert record["map"] == {"run": uid, "content": checksum(path), "dataset": "track"}
    assert record["request"]["map"] == {"run": uid, "content": checksum(path)}
    found = hive.runs.get(second)
    assert found.configuration_id != hive.runs.get(first).configuration_id
    assert found.metrics is not None
    assert found.metrics["map.localisation_time"] == pytest.approx(2.5)
    assert found.metrics["map.localised_fraction"] == pytest.approx(0.75)
    again = run(hive, map=uid)
    assert hive.runs.get(again).configuration_id == found.configuration_id
    search = hive.searches.read("map = true")
    assert {record.id for record in hive.runs.page(search).records} == {second, again}
    yaml = hive.configurations.export_yaml(found.configuration_id)
    assert hive.configurations.import_yaml(yaml, "c.yaml").record.id == found.configuration_id


def test_an_experiment_starts_with_a_map_and_survives_the_loss_of_the_database(
    hive: Hive, engine: FakeExecutor
) -> None:
    first = run(hive)
    text = f"name: again\nalgorithms: tiny-lidar\ndatasets: track\nevaluate: false\nmap: '{first}'\nrepeats: 2\n"
    hive.experiments.start(ExperimentSource(text, "again.yaml"))
    hive.worker().run(until_idle=True)
    numbers = hive.experiments.run_ids("again")
    maps = {number: hive.runs.get(number).input_map for number in numbers}
    assert None not in maps.values()
    hive.close()
    (hive.settings.data / "slamhive.db").unlink()
    opened = open_hive()
    reindex(opened, lambda done, total: None)
    assert {number: opened.runs.get(number).input_map for number in numbers} == maps
    opened.close()
    bad = text.replace("tiny-lidar", "tiny-mapless").replace("again", "bad")
    with pytest.raises(InvalidInput, match=r"bad\.yaml line 1: tiny-mapless cannot start with a map"):
        hive.experiments.start(ExperimentSource(bad, "bad.yaml"))


def test_what_is_no_map_is_refused_in_one_line(hive: Hive, engine: FakeExecutor) -> None:
    first = run(hive)
    without = run(hive, map=str(first))
    cases = (
        ({"algorithm": "tiny-mapless", "map": str(first)}, InvalidInput, "tiny-mapless cannot start with a map"),
        ({"algorithm": "tiny-other", "map": str(first)}, InvalidInput, "has a map of tiny-lidar, which tiny-other"),
        ({"map": str(without)}, InvalidInput, f"run {without} has saved no map"),
        ({"map": "99"}, NotFound, "unknown run 99"),
        ({"map": "yesterday"}, InvalidInput, "no run has the number or uid 'yesterday'"),
    )
    for changes, kind, told in cases:
        with pytest.raises(kind, match=told) as refused:
            run(hive, **changes)
        assert "\n" not in str(refused.value)
    waiting = hive.runs.submit(Submission("tiny-lidar", "track", evaluate=False))[0].id
    with pytest.raises(InvalidInput, match=f"run {waiting} is queued"):
        hive.runs.submit(Submission("tiny-lidar", "track", map=str(waiting)))


@pytest.mark.parametrize("change", ["gone", "another"])
def test_a_map_that_is_not_the_same_any_more_fails_the_run(hive: Hive, engine: FakeExecutor, change: str) -> None:
    first = run(hive)
    queued = hive.runs.submit(Submission("tiny-lidar", "track", evaluate=False, map=str(first)))[0].id
    path = hive.runs.folder(first).result / "session.osa"
    path.unlink() if change == "gone" else path.write_bytes(b"another")
    hive.worker().run(until_idle=True)
    found = hive.runs.get(queued)
    assert (found.state, found.reason) == (RunState.FAILED, FailureReason.PREPROCESS_ERROR)
    assert ("has saved no map" if change == "gone" else "has changed since") in str(found.detail)


def test_a_map_of_another_dataset_is_said(hive: Hive, engine: FakeExecutor) -> None:
    first = run(hive)
    make_dataset(hive.settings.data, "yard")
    submission = Submission("tiny-lidar", "yard", map=str(first))
    assert "the map shows track, the run uses yard" in str(hive.configurations.map_note(submission))
    assert hive.configurations.map_note(Submission("tiny-lidar", "track", map=str(first))) is None
    done = CliRunner().invoke(main, ["run", "tiny-lidar", "yard", "--map", str(first)])
    assert done.exit_code == 0, done.output
    assert "note: the map shows track" in done.stderr
    assert hive.runs.page(matching()).records[0].input_map is not None


def test_a_map_needs_an_output(hive: Hive, engine: FakeExecutor) -> None:
    folder = hive.catalogue.package("tiny").folder
    yaml = (folder / "algorithm.yaml").read_text()
    (folder / "algorithm.yaml").write_text(yaml.replace("map_output: session.osa\n", ""))
    with pytest.raises(InvalidInput, match="mode lidar has map_input, but the package has no map_output"):
        hive.catalogue.algorithm("tiny-lidar")
