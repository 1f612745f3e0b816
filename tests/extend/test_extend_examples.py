"""Every example of docs/extend, installed as a package and used through the command line and the pages."""

from __future__ import annotations

import contextlib
import http.cookiejar
import re
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from slamhive.recordings.room import RoomOptions, render_room
from tests.extend.plugin_packages import CHECKOUT, EXTEND, Command
from tests.forked_commands import Run
from tests.services.tiny_project import make_dataset, make_project
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.integration

KEY = "jerk.rms"


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = make_project(tmp_path_factory.mktemp("project") / "root")
    for name in ("templates", "static", "docs"):
        if (folder / name).is_dir():
            (folder / name).rmdir()
        (folder / name).symlink_to(CHECKOUT / name)
    return folder


@pytest.fixture(scope="module")
def evaluated(root: Path, examples: Path, carry_out: Run, tmp_path_factory: pytest.TempPathFactory) -> Command:
    """One run that was evaluated with the plug-ins, and one that failed."""
    data = tmp_path_factory.mktemp("data")
    make_dataset(data)
    command = Command(carry_out, root, data, examples)
    command.run("run", "tiny", "track", "--set", "seconds=0.01", "--wait")
    command.run("run", "tiny", "track", "--set", "seconds=0.01", "--set", "behaviour=crash", "--wait", expected=1)
    return command


@contextlib.contextmanager
def serving(command: Command) -> Iterator[str]:
    """The address of a server that runs in a process of its own."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    arguments = [sys.executable, "-m", "slamhive", "serve", "--port", str(port), "--no-worker"]
    with subprocess.Popen(arguments, env=command.environment, cwd=CHECKOUT, stdout=subprocess.DEVNULL) as server:
        address = f"http://127.0.0.1:{port}"
        try:
            until = time.monotonic() + PATIENCE_S
            while True:
                try:
                    urllib.request.urlopen(f"{address}/help/").close()
                    break
                except urllib.error.URLError:
                    assert server.poll() is None
                    assert time.monotonic() < until
                    time.sleep(0.1)
            yield address
        finally:
            server.terminate()


def get(address: str) -> str:
    with urllib.request.urlopen(address) as answer:
        return str(answer.read().decode())


def test_the_page_names_every_example():
    text = (EXTEND / "index.md").read_text()
    files = {path.relative_to(EXTEND).parts[0] for path in EXTEND.rglob("*") if path.is_file()} - {"index.md"}
    assert {name for name in files if f"]({name}" not in text} == {"__pycache__"} & files


def test_plugins_are_listed(evaluated: Command):
    found = {(entry["seam"], entry["name"]): entry for entry in evaluated.json("plugins")}
    assert set(found) >= {
        ("metric", KEY),
        ("evaluator", "jerk"),
        ("dataset importer", "tum-depth"),
        ("dataset exporter", "imu-csv"),
        ("pre-processing step", "imu_scale"),
        ("protocol", "strict"),
        ("web page", "failures"),
        ("algorithm", "dead-reckoning"),
        ("executor", "plain"),
    }
    assert {entry["state"] for entry in found.values()} == {"loaded"}
    assert {(entry["package"], entry["version"]) for (seam, _), entry in found.items() if seam == "metric"} == {
        ("slamhive-jerk", "1.0.0")
    }
    assert "slamhive-jerk" in evaluated.run("plugins").stdout
    (check,) = [entry for entry in evaluated.json("doctor") if entry["name"] == "plug-ins"]
    assert check["verdict"] == "ok"
    assert "slamhive-jerk 1.0.0" in check["found"]


def jerk_of_the_estimate(command: Command) -> float:
    """The metric of the example, from the trajectory in the run folder; alignment does not change it."""
    data = Path(command.environment["SLAMHIVE_DATA"])
    rows = np.loadtxt(data / "runs" / "1" / "result" / "traj.txt")
    jerk = rows[:, 1:4]
    for _ in range(3):
        jerk = np.gradient(jerk, rows[:, 0], axis=0)
    return float(np.sqrt(np.mean(np.linalg.norm(jerk, axis=1) ** 2)))


def test_a_metric_is_computed_listed_and_searched(evaluated: Command):
    value = evaluated.json("runs", "show", "1")["metrics"][KEY]
    assert value["unit"] == "m/s³"
    assert value["value"] == pytest.approx(jerk_of_the_estimate(evaluated), rel=1e-6)
    found = evaluated.json("runs", "--where", f"{KEY} > 0", "--sort", KEY)
    assert [run["id"] for run in found] == [1]
    assert evaluated.json("runs", "--where", f"{KEY} < 0") == []
    assert f"{value['value']}"[:8] in evaluated.run("runs", "--columns", f"id,{KEY}", "--csv").stdout


def test_a_metric_survives_an_archive_with_and_without_its_plugin(
    evaluated: Command, root: Path, examples: Path, carry_out: Run, tmp_path: Path
):
    evaluated.run("archive", "export", str(tmp_path / "all.zip"), "--all")
    for plugins, unit, label in (((examples,), "m/s³", "Jerk RMS"), ((), None, KEY)):
        copy = Command(carry_out, root, tmp_path / f"copy-{label}", *plugins)
        copy.run("archive", "import", str(tmp_path / "all.zip"))
        metrics = copy.json("runs", "show", "1")["metrics"]
        assert metrics[KEY] == {**evaluated.json("runs", "show", "1")["metrics"][KEY], "unit": unit}
        assert KEY in copy.run("runs", "show", "1", "--all").stdout
        with serving(copy) as address:
            assert label in get(f"{address}/runs/1")


def test_a_preset_evaluates(evaluated: Command):
    assert "strict" in evaluated.run("protocol", "list").stdout
    evaluated.run("evaluate", "1", "--protocol", "strict")
    rows = {row["name"]: row for row in evaluated.json("protocol", "compare", "1")}
    assert set(rows["strict"]["figures"]) == {"ate.rmse", "ate.max"}


def test_a_plot_type_draws(evaluated: Command, tmp_path: Path):
    file = tmp_path / "history.yaml"
    file.write_text(
        f"name: h\nselect:\n  all: {{where: 'dataset = track'}}\nforms:\n- {{form: history, metric: {KEY}}}\n"
    )
    evaluated.run("analyse", str(file), "--out", str(tmp_path / "report"), "--figures", "svg")
    drawn = list((tmp_path / "report").rglob(f"*history_{KEY}*.svg"))
    assert len(drawn) == 1
    assert "Jerk RMS" in drawn[0].read_text()


def test_an_executor_runs(evaluated: Command):
    evaluated.run("run", "tiny", "track", "--executor", "plain", "--set", "seconds=0.01", "--wait")
    (run,) = evaluated.json("runs", "--where", "executor = plain")
    assert run["state"] == "succeeded"
    assert run["metrics"][KEY]["value"] > 0


def test_an_executor_has_settings_of_its_own(evaluated: Command, root: Path, examples: Path, carry_out: Run):
    found = {entry["name"]: entry for entry in evaluated.json("settings")}
    assert found["PLAIN_SHELL"]["value"] == "/bin/sh"
    data = Path(evaluated.environment["SLAMHIVE_DATA"])
    other = Command(carry_out, root, data, examples, plain_shell="/bin/none")
    assert {entry["name"]: entry for entry in other.json("settings")}["PLAIN_SHELL"]["value"] == "/bin/none"
    refused = other.run("run", "tiny", "track", "--executor", "plain", expected=1)
    assert "there is no shell /bin/none; change PLAIN_SHELL" in refused.stderr


def test_an_importer_imports(evaluated: Command, tmp_path: Path):
    source = tmp_path / "desk"
    (source / "depth").mkdir(parents=True)
    for number in range(3):
        cv2.imwrite(str(source / "depth" / f"{number}.png"), np.full((48, 64), 5000 + number, np.uint16))
    (source / "depth.txt").write_text("# depth\n" + "".join(f"{10 + n / 10} depth/{n}.png\n" for n in range(3)))
    (source / "groundtruth.txt").write_text("10 0 0 0 0 0 0 1\n10.2 1 0 0 0 0 0 1\n")
    made = evaluated.json("dataset", "import", str(source), "--format", "tum-depth", "--name", "desk")
    assert made["sensors"][0]["rate_hz"] == pytest.approx(10)
    evaluated.run("dataset", "import", str(source), "--name", "again")
    (source / "depth.txt").write_text("10 depth/0.png\nnonsense\n")
    told = evaluated.run("dataset", "import", str(source), "--name", "bad", expected=1).stderr
    assert "depth.txt:2: 'nonsense' is no 'timestamp file'; correct the line" in told


def test_an_exporter_exports_a_step_makes_a_variant_and_an_algorithm_runs_on_it(evaluated: Command):
    data = Path(evaluated.environment["SLAMHIVE_DATA"])
    render_room(data / "datasets" / "room", RoomOptions(duration_s=2.0, width=64, height=48), lambda *_: None)
    folder = data / "imu-csv"
    evaluated.run("dataset", "export", "room", "--format", "imu-csv", "--partial", "--to", str(folder))
    assert len((folder / "imu0.csv").read_text().splitlines()) == 402
    assert "gyroscope" in evaluated.run("variants", "steps", "imu_scale").stdout
    made = evaluated.json("variants", "make", "room", "--step", "imu_scale gyroscope=1.02")
    assert made["dataset"] == "room"
    assert "dead-reckoning" in evaluated.run("algorithm", "list").stdout
    evaluated.run("run", "dead-reckoning", "room", "--playback", "sequential", "--wait")
    evaluated.run(
        "run", "dead-reckoning", "room", "--playback", "sequential", "--step", "imu_scale accelerometer=2", "--wait"
    )
    runs = evaluated.json("runs", "--where", "algorithm = dead-reckoning", "--sort", "id", "--ascending")
    errors_m = [run["metrics"]["ate.rmse"]["value"] for run in runs]
    assert errors_m[0] < 0.2 < errors_m[1]


def test_a_page_is_in_the_menu_and_keeps_the_rules(evaluated: Command, root: Path, examples: Path, carry_out: Run):
    with serving(evaluated) as address:
        assert re.search(r'<a [^>]*href="/failures/"[^>]*>.*?Failures', get(address))
        opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor(http.cookiejar.CookieJar()))
        page = opener.open(f"{address}/failures/").read().decode()
        assert "1 run failed, the newest first." in page
        with pytest.raises(urllib.error.HTTPError, match="400"):
            opener.open(f"{address}/failures/again", data=b"run=2")
        token = re.findall(r'name="csrf_token" value="([^"]+)"', page)[0]
        form = urllib.parse.urlencode({"csrf_token": token, "run": 2}).encode()
        assert "waits for a worker" in opener.open(f"{address}/failures/again", data=form).read().decode()
    data = Path(evaluated.environment["SLAMHIVE_DATA"])
    viewing = Command(carry_out, root, data, examples, mode="view-only")
    with serving(viewing) as address:
        assert "Start again" not in get(f"{address}/failures/")
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(f"{address}/failures/again", data=form)
