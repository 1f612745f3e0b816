"""What follows from a stored outcome, and was left out, is made by the worker that starts next."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from slamhive.base.errors import Unavailable
from slamhive.base.settings import Mode
from slamhive.documents.submission import Submission
from slamhive.domain.run import RunState
from slamhive.executors.process.executor import ProcessExecutor
from slamhive.run_folder.profiling import plots_are_missing
from slamhive.services.hive import Hive, open_hive
from slamhive.services.worker import collecting
from slamhive.web.app import create_app

pytestmark = pytest.mark.integration

CHECKOUT = Path(__file__).resolve().parents[2]
LONG = Submission("tiny", "track", {"seconds": 0.6})
UNEVALUATED = replace(LONG, evaluate=False)


def work(hive: Hive) -> None:
    hive.worker().run(until_idle=True)


def files_of(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def test_plots_and_the_current_protocol_are_made_again(hive: Hive) -> None:
    (run,) = hive.runs.submit(LONG)
    work(hive)
    folder = hive.runs.folder(run.id)
    whole = files_of(folder.root)
    assert {"profiling_cpu.png", "profiling_ram.png", "evaluations/current"} <= whole.keys()
    for missing in (folder.profiling_cpu_plot, folder.profiling_ram_plot, folder.current_protocol):
        missing.unlink()
    work(hive)
    assert files_of(folder.root) == whole


def test_what_is_there_is_left_as_it_is(hive: Hive) -> None:
    (run,) = hive.runs.submit(LONG)
    work(hive)
    folder = hive.runs.folder(run.id)
    folder.profiling_cpu_plot.write_bytes(b"own")
    folder.write_current_protocol("chosen")
    folder.profiling_ram_plot.unlink()
    folder.profiling.unlink()
    work(hive)
    assert folder.profiling_cpu_plot.read_bytes() == b"own"
    assert folder.read_current_protocol() == "chosen"
    assert not folder.profiling_ram_plot.exists()


@pytest.mark.parametrize("step", ["remove", "plots"])
def test_trouble_after_the_outcome_leaves_out_no_more_than_it_must(
    hive: Hive, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    def trouble(*_: object) -> None:
        raise Unavailable("the disk is full")

    with monkeypatch.context() as troubled:
        if step == "remove":
            troubled.setattr(ProcessExecutor, "remove", trouble)
        else:
            troubled.setattr(collecting, "write_plots", trouble)
        (run,) = hive.runs.submit(UNEVALUATED)
        work(hive)
    assert hive.runs.get(run.id).state is RunState.SUCCEEDED
    assert plots_are_missing(hive.runs.folder(run.id)) is (step == "plots")
    work(hive)
    assert not plots_are_missing(hive.runs.folder(run.id))


@pytest.mark.parametrize(
    "profile", ["", "time,cpu_usage\n1,2\n", "time,cpu_usage,memory_usage\n" + "nan,nan,nan\n1e300,-1e300,1e300\n" * 9]
)
def test_a_profile_that_nothing_can_be_drawn_of_holds_up_no_worker(hive: Hive, profile: str) -> None:
    runs = hive.runs.submit(replace(UNEVALUATED, repeat=2))
    work(hive)
    for run in runs:
        hive.runs.folder(run.id).profiling_ram_plot.unlink()
    hive.runs.folder(runs[0].id).profiling.write_text(profile)
    work(hive)
    assert not plots_are_missing(hive.runs.folder(runs[-1].id))


def test_a_view_only_server_writes_nothing(hive: Hive, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (run,) = hive.runs.submit(LONG)
    work(hive)
    folder = hive.runs.folder(run.id)
    folder.profiling_cpu_plot.unlink()
    folder.current_protocol.unlink()
    before = files_of(folder.root)
    (tmp_path / "project" / "templates").rmdir()
    for name in ("templates", "static", "docs"):
        (tmp_path / "project" / name).symlink_to(CHECKOUT / name)
    monkeypatch.setenv("SLAMHIVE_MODE", Mode.VIEW_ONLY.value)
    looking = open_hive()
    client = create_app(looking).test_client()
    assert client.get(f"/runs/{run.id}").status_code == 200
    assert client.get(f"/runs/{run.id}/files/profiling_cpu.png").status_code == 404
    assert files_of(folder.root) == before
    looking.close()
