"""Rented clusters of an installation: what commands refuse, and what a sweep removes."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from slamhive.base.clock import utc_now
from slamhive.base.errors import Conflict, Forbidden, InvalidInput, NotFound
from slamhive.base.settings import Mode
from slamhive.cli import main
from slamhive.cloud.resources import UID_TAG, CloudRecords
from slamhive.documents.machines import CloudState
from slamhive.services.clouds import Clouds
from slamhive.services.experiments import ExperimentSource
from slamhive.services.hive import Hive
from tests.cloud.cloud_world import ENDPOINT, KEYS, FakeTime, cloud_text
from tests.cloud.ecs_server import EcsServer
from tests.cloud.rental import answered_by
from tests.services.conftest import opened_hive

pytestmark = pytest.mark.integration

EXPERIMENT = "name: two\nalgorithms: tiny\ndatasets: track\nrepeats: 1000\n"


@pytest.fixture(scope="module")
def hive(tmp_path_factory: pytest.TempPathFactory, sqlite_template: Path) -> Iterator[Hive]:
    folder = tmp_path_factory.mktemp("clouds")
    with pytest.MonkeyPatch.context() as patch, opened_hive(folder, patch, sqlite_template) as opened:
        yield opened


@pytest.fixture
def server() -> Iterator[EcsServer]:
    found = EcsServer()
    with answered_by(found):
        yield found


@pytest.fixture
def time() -> FakeTime:
    return FakeTime()


def clouds_of(hive: Hive, data: Path, time: FakeTime, mode: Mode = Mode.WORKSTATION) -> Clouds:
    """The clouds of another data root, with the catalogue of ``hive``."""
    changes = {"data": data, "mode": mode, "cloud_join": "k3s agent", "cloud_endpoint": ENDPOINT}
    settings = hive.settings.with_values(changes)
    return Clouds(settings, hive.catalogue, lambda: hive.experiments, KEYS, time.clock)


@pytest.fixture
def clouds(hive: Hive, server: EcsServer, time: FakeTime, tmp_path: Path) -> Clouds:
    return clouds_of(hive, tmp_path / "data", time)


def cloud_file(folder: Path, **changes: object) -> Path:
    path = folder / "cloud.yaml"
    path.write_text(cloud_text(**{"prepare": "", "nodes": 2, **changes}))
    return path


def test_the_plan_takes_its_hours_from_the_experiment(clouds: Clouds, hive: Hive, tmp_path: Path) -> None:
    (tmp_path / "two.yaml").write_text(EXPERIMENT)
    path = cloud_file(tmp_path)
    path.write_text(path.read_text().replace("hours: 10", "experiment: two.yaml"))
    plan = clouds.plan(path)
    preview = hive.experiments.preview(ExperimentSource(EXPERIMENT))
    assert plan.runs == preview.runs == 1000
    assert plan.run_h == pytest.approx((preview.time_s - preview.build_time_s) * preview.slots / 3600 / plan.nodes)


def test_a_cluster_from_up_to_down(clouds: Clouds, server: EcsServer, tmp_path: Path) -> None:
    up = clouds.up(cloud_file(tmp_path))
    assert (up.name, up.state, len(up.resources)) == ("bench", CloudState.UP, 5)
    assert [status.name for status in clouds.status()] == ["bench"]
    assert clouds.down("bench") == 3
    assert server.kept == {}
    assert clouds.status() == []
    assert clouds.status("bench")[0].resources == ()


def test_the_record_is_there_before_anything_is_created(clouds: Clouds, server: EcsServer, tmp_path: Path) -> None:
    stored: list[str] = []

    def look(number: int, action: str) -> None:
        if not action.startswith("Describe"):
            stored.append((tmp_path / "data" / "clouds" / "bench.json").read_text())

    server.before = look
    clouds.up(cloud_file(tmp_path))
    uids = {json.loads(text)["uid"] for text in stored}
    assert uids == {entry["tags"][UID_TAG] for entry in server.kept.values()}


def test_two_commands_do_not_work_on_one_cluster(clouds: Clouds, tmp_path: Path) -> None:
    clouds.up(cloud_file(tmp_path))
    with (
        CloudRecords(tmp_path / "data" / "clouds").held("bench"),
        pytest.raises(Conflict, match="another command is working on cluster bench"),
    ):
        clouds.down("bench")


def test_up_again_changes_nothing_and_another_file_is_refused(
    clouds: Clouds, server: EcsServer, tmp_path: Path
) -> None:
    clouds.up(cloud_file(tmp_path))
    kept = set(server.kept)
    clouds.up(cloud_file(tmp_path))
    assert set(server.kept) == kept
    with pytest.raises(Conflict, match="cluster bench is up, and its cloud file was another"):
        clouds.up(cloud_file(tmp_path, nodes=3))


def test_a_name_that_another_installation_uses_is_refused(
    clouds: Clouds, hive: Hive, time: FakeTime, tmp_path: Path
) -> None:
    clouds.up(cloud_file(tmp_path))
    with pytest.raises(Conflict, match="the name bench is taken: another installation has machine"):
        clouds_of(hive, tmp_path / "colleague", time).up(cloud_file(tmp_path))


def test_a_sweep_leaves_clusters_that_are_up_and_those_of_others(
    clouds: Clouds, hive: Hive, server: EcsServer, time: FakeTime, tmp_path: Path
) -> None:
    path = cloud_file(tmp_path)
    clouds.up(path)
    colleague = clouds_of(hive, tmp_path / "colleague", time)
    assert [(swept.deleted, swept.foreign) for swept in clouds.sweep()] == [(0, 0)]
    swept = colleague.sweep(path)
    assert [(entry.deleted, entry.foreign) for entry in swept] == [(0, 5)]
    assert len(server.kept) == 5
    colleague.sweep(path, everything=True)
    assert server.kept == {}


def test_a_sweep_removes_what_is_past_its_end_and_what_no_record_knows(
    clouds: Clouds, server: EcsServer, time: FakeTime, tmp_path: Path
) -> None:
    path = cloud_file(tmp_path)
    end = clouds.up(path).ends_at
    time.now = end
    clouds.sweep()
    assert server.kept == {}
    assert clouds.status("bench")[0].state is CloudState.DOWN
    clouds.up(path)
    (tmp_path / "data" / "clouds" / "bench.json").unlink()
    clouds.up(cloud_file(tmp_path, nodes=1))
    assert len(server.of("machine")) == 1


def test_view_only_servers_rent_nothing(hive: Hive, server: EcsServer, time: FakeTime, tmp_path: Path) -> None:
    reader = clouds_of(hive, tmp_path / "data", time, Mode.VIEW_ONLY)
    with pytest.raises(Forbidden, match="view-only"):
        reader.up(cloud_file(tmp_path))
    assert server.calls == []


def test_mistakes_create_nothing(clouds: Clouds, server: EcsServer, tmp_path: Path) -> None:
    with pytest.raises(NotFound, match="unknown cluster 'bnch'"):
        clouds.down("bnch")
    with pytest.raises(InvalidInput, match="no cluster was ever up here"):
        clouds.sweep()
    with pytest.raises(InvalidInput, match=r"public_key /nowhere\.pub cannot be read: No such file"):
        clouds.up(cloud_file(tmp_path, prepare="prepare: {{user: admin, public_key: {key}}}\n"))
    assert [action for action in server.calls if not action.startswith("Describe")] == []


def command(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["cloud", *map(str, arguments)])


def test_commands_print_the_plan_and_mistakes_in_one_line(hive: Hive, tmp_path: Path) -> None:
    path = cloud_file(tmp_path, prepare="prepare: {{user: admin, public_key: {key}}}\n")
    path.write_text(path.read_text().replace("2026-11-01", f"{utc_now():%Y-%m-%d}"))
    shown = command("plan", path)
    assert shown.exit_code == 0, shown.output
    assert "created: 1 firewall, 2 machines with a disk of 40 GB, 1 image with its snapshot" in shown.stdout
    assert "at most 12.16 of 30.00 USD" in shown.stdout
    path.write_text(path.read_text().replace("budget: 30", "budget: 1"))
    refused = command("plan", path)
    assert refused.exit_code == 1
    assert refused.stderr.startswith("error: budget 1 USD is too low")
    assert command("up", path).stderr.startswith("error: CLOUD_JOIN is empty")
    assert command("status").stderr.startswith("no cluster is up")
