"""Broken plug-ins: each is named with the reason and the remedy, and none takes anything else down."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.extend.plugin_packages import Command, install, write_wheel
from tests.forked_commands import Run
from tests.services.tiny_project import make_dataset, make_project

pytestmark = pytest.mark.integration

UNIMPORTABLE = "import no_such_library\n"
EXITING = "raise SystemExit('bye')\n"
RAISING = "raise RuntimeError('two\\nlines')\n"
UNMADE = """
def make(context):
    raise RuntimeError("no licence server")
"""
WRONG = """
from slamhive.domain.metrics import Direction, Metric
from slamhive.evaluation.evaluators.base import MetricValues
from slamhive.base.settings import ExecutorOption

class Untyped:
    options = ("shell",)

class Taking:
    options = (ExecutorOption("pids", "", "x"),)

class Half:
    keys = ("half.done",)

class Greedy:
    keys = ("ate.rmse",)
    def evaluate(self, paired):
        raise AssertionError

class Failing:
    keys = ("fail.always",)
    def evaluate(self, paired):
        return {}["nothing"]

class Sprawling(Failing):
    keys = ("fail.sprawl",)
    def evaluate(self, paired):
        return MetricValues({"ate.rmse": 0.0})

HALF, GREEDY, FAILING, SPRAWLING = Half(), Greedy(), Failing(), Sprawling()
METRICS = [Metric(key, key, "", Direction.LOWER, "x") for key in ("fail.always", "fail.sprawl")]
UNNAMEABLE = Metric("Jerk", "Jerk", "", Direction.LOWER, "x")
"""
WRONG_TABLES = """
[project.entry-points."slamhive.dataset_importers"]
number = "slamhive_wrong:METRICS"
missing = "slamhive_wrong:NOTHING"
kitti-odometry = "slamhive_wrong:HALF"
[project.entry-points."slamhive.variant_steps"]
number = "slamhive_wrong:Half"
[project.entry-points."slamhive.metrics"]
fails = "slamhive_wrong:METRICS"
unnameable = "slamhive_wrong:UNNAMEABLE"
[project.entry-points."slamhive.evaluators"]
half = "slamhive_wrong:HALF"
class = "slamhive_wrong:Failing"
greedy = "slamhive_wrong:GREEDY"
failing = "slamhive_wrong:FAILING"
sprawling = "slamhive_wrong:SPRAWLING"
[project.entry-points."slamhive.algorithms"]
empty = "slamhive_wrong"
[project.entry-points."slamhive.executors"]
untyped = "slamhive_wrong:Untyped"
run = "slamhive_wrong:Taking"
"""
TAKEN = """
from slamhive.domain.protocol import Alignment, Protocol
from slamhive.evaluation.presets import Preset
TUM = Preset("Ours", Protocol(Alignment.NONE), (), "", "")
"""
PAGES = """
from flask import Blueprint
from slamhive.web.pages import PluginPage
RUNS = PluginPage("Runs", Blueprint("mine", __name__, url_prefix="/runs"))
NAMED = PluginPage("Runs", Blueprint("runs", __name__, url_prefix="/mine"))
BARE = PluginPage("Bare", Blueprint("bare", __name__))
INDEXLESS = PluginPage("Indexless", Blueprint("indexless", __name__, url_prefix="/indexless"))
"""


def entry_points(group: str, **entries: str) -> str:
    lines = "".join(f'{name} = "{value}"\n' for name, value in entries.items())
    return f'\n[project.entry-points."slamhive.{group}"]\n{lines}'


@pytest.fixture(scope="module")
def broken(examples: Path, carry_out: Run, tmp_path_factory: pytest.TempPathFactory) -> Command:
    """A project with a run, where the good examples are installed and all kinds of broken plug-ins."""
    folder = tmp_path_factory.mktemp("broken")
    packages = [
        write_wheel(folder / "wheels", module, code, tables)
        for module, code, tables in (
            ("slamhive_unimportable", UNIMPORTABLE, entry_points("executors", cluster="slamhive_unimportable:MAKE")),
            ("slamhive_unmade", UNMADE, entry_points("executors", unmade="slamhive_unmade:make")),
            ("slamhive_exiting", EXITING, entry_points("variant_steps", exiting="slamhive_exiting:STEP")),
            ("slamhive_raising", RAISING, entry_points("analysis_forms", raising="slamhive_raising:FORM")),
            ("slamhive_wrong", WRONG, WRONG_TABLES),
            ("slamhive_taken", TAKEN, entry_points("protocols", tum="slamhive_taken:TUM", se3="slamhive_taken:TUM")),
            (
                "slamhive_pages",
                PAGES,
                entry_points(
                    "pages",
                    rules="slamhive_pages:RUNS",
                    named="slamhive_pages:NAMED",
                    bare="slamhive_pages:BARE",
                    indexless="slamhive_pages:INDEXLESS",
                ),
            ),
        )
    ]
    make_dataset(folder / "data")
    installed = install(packages, folder / "installed")
    root = make_project(folder / "project")
    return Command(carry_out, root, folder / "data", installed, examples)


EXPECTED = {
    ("executor", "cluster"): r"ModuleNotFoundError: No module named 'no_such_library'",
    ("executor", "unmade"): r"RuntimeError: no licence server",
    ("pre-processing step", "exiting"): r"SystemExit: bye",
    ("pre-processing step", "number"): r"it is no subclass of Step, but <class 'slamhive_wrong.Half'>",
    ("plot type", "raising"): r"RuntimeError: two lines",
    (
        "dataset importer",
        "number",
    ): r"it is no Importer, but of type list without detect, options, plan, refines, title",
    ("dataset importer", "missing"): r"AttributeError: module 'slamhive_wrong' has no attribute 'NOTHING'",
    (
        "dataset importer",
        "kitti-odometry",
    ): r"it is no Importer, but of type Half without detect, options, plan, refines, title",
    ("metric", "unnameable"): r"the metric key 'Jerk' is not allowed",
    ("evaluator", "half"): r"it is no Evaluator, but of type Half without evaluate",
    ("evaluator", "class"): r"it is the class Failing, not an object",
    ("evaluator", "greedy"): r"its metric 'ate.rmse' is that of the evaluator 'ate'",
    ("algorithm", "empty"): r"holds no algorithm.yaml",
    ("executor", "untyped"): r"its options are no tuple of ExecutorOption",
    ("executor", "run"): r"its option pids would be the setting RUN_PIDS, which SLAM Hive has",
    ("protocol", "tum"): r"the name 'tum' is taken by slamhive",
    ("protocol", "se3"): r"the name 'se3' is that of an alignment",
    ("web page", "rules"): r"there are pages below /runs already",
    ("web page", "named"): r"there is a blueprint 'runs' already",
    ("web page", "bare"): r"its blueprint has the url_prefix None",
    ("web page", "indexless"): r"its blueprint has no view 'indexless.index'",
}


def test_each_is_listed_with_its_reason_and_remedy(broken: Command):
    entries = broken.json("plugins")
    found = {(entry["seam"], entry["name"]): entry for entry in entries if entry["state"] == "broken"}
    assert found.keys() == EXPECTED.keys()
    for key, words in EXPECTED.items():
        assert re.search(words, found[key]["problem"]), found[key]
        assert f"remove it: pip uninstall {found[key]['package']}" in found[key]["remedy"]
    good = {entry["package"] for entry in entries if entry["state"] == "loaded"}
    assert good >= {"slamhive-jerk", "slamhive-tum-depth", "slamhive-failures", "slamhive-dead-reckoning"}


def test_the_doctor_names_each(broken: Command):
    checks = [check for check in broken.json("doctor", expected=1) if check["name"].startswith("plug-in")]
    assert len(checks) == len(EXPECTED)
    assert [check["found"] for check in checks if "no licence server" in check["found"]] == [
        "executor 'unmade' (slamhive_unmade:make) cannot be used: RuntimeError: no licence server"
    ]
    assert {check["verdict"] for check in checks} == {"failed"}
    (check,) = [check for check in checks if "cluster" in check["found"]]
    assert check["name"] == "plug-in slamhive-unimportable 1.0.0"
    assert check["found"].startswith("executor 'cluster' (slamhive_unimportable:MAKE) cannot be used: ModuleNotFound")
    assert "install what it needs, or remove it: pip uninstall slamhive-unimportable" in check["remedy"]


def test_a_command_warns_once_and_goes_on(broken: Command, tmp_path: Path):
    (tmp_path / "depth").mkdir()
    told = broken.run("dataset", "import", str(tmp_path), "--name", "x", expected=1).stderr
    assert "looks like tum-depth (found depth), but lacks depth.txt" in told
    assert told.count("dataset importer 'number' of slamhive-wrong 1.0.0") == 1
    assert "Traceback" not in told


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ("dataset", "import", ".", "--format", "missing", "--name", "x"),
            "dataset importer 'missing' of slamhive-wrong 1.0.0",
        ),
        (("variants", "steps", "exiting"), "cannot be used: SystemExit: bye"),
        (("run", "tiny", "track", "--executor", "cluster"), "cannot be used: ModuleNotFoundError"),
        (("run", "tiny", "track", "--executor", "unmade"), "cannot be used: RuntimeError: no licence server"),
        (("algorithm", "show", "empty"), "holds no algorithm.yaml"),
    ],
)
def test_who_asks_for_a_broken_one_is_told_why(broken: Command, arguments: tuple[str, ...], words: str):
    told = broken.run(*arguments, expected=1).stderr.splitlines()[-1]
    assert words in told
    assert "pip uninstall" in told


def test_an_evaluator_that_fails_leaves_out_its_own_metrics_alone(broken: Command):
    broken.run("run", "tiny", "track", "--set", "seconds=0.01", "--wait")
    metrics = broken.json("runs", "show", "1")["metrics"]
    assert metrics["ate.rmse"]["value"] > 0
    assert metrics["jerk.rms"]["value"] > 0
    assert not {"fail.always", "fail.sprawl"} & metrics.keys()
    data = Path(broken.environment["SLAMHIVE_DATA"])
    (result,) = data.glob("runs/1/evaluation*/*/result.json")
    written = result.read_text()
    assert "the evaluator 'failing' failed: KeyError: 'nothing'" in written
    assert "the evaluator 'sprawling' found 'ate.rmse', which is none of its keys" in written
    assert "evaluator 'half' of slamhive-wrong 1.0.0 (slamhive_wrong:HALF) cannot be used" in written


def test_auto_passes_over_an_executor_that_cannot_be_made(broken: Command):
    broken.environment.pop("SLAMHIVE_EXECUTOR", None)
    found = {check["name"]: check["verdict"] for check in broken.json("doctor", expected=1)}
    assert found["executor in force"] == "ok"
