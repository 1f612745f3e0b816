"""No file makes SLAM Hive fail: each mutation of each format is read, or refused in one line, and costs little."""

from __future__ import annotations

import functools
import json
import random
import resource
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from slamhive.analysis.analysis_file import parse_analysis
from slamhive.base.bounds import read_record
from slamhive.base.errors import SlamHiveError
from slamhive.base.settings_sources import describe, load_settings
from slamhive.documents.catalogue import TruthTrialDocument
from slamhive.domain.sensors import SensorSetup
from slamhive.evaluation.evaluators.consistency import read_covariances
from slamhive.evaluation.evaluators.map_quality import read_pcd
from slamhive.evaluation.evaluators.relations import read_relations
from slamhive.evaluation.job import result_from_json
from slamhive.packages.algorithm_file import load_algorithms
from slamhive.packages.dataset_file import load_dataset
from slamhive.packages.protocol_file import load_protocol
from slamhive.run_folder.folder import RunFolder
from slamhive.run_folder.outcome import inspect_trajectory
from slamhive.run_folder.profiling import read_profile
from slamhive.run_folder.untrusted import read_numeric_columns, read_untrusted_json
from slamhive.runtime import config as run_config
from slamhive.runtime.pcd import write_pcd
from slamhive.services.archive.exporting import ExportRequest, export_archive
from slamhive.services.archive.importing import ArchiveImport
from slamhive.services.archive.layout import ABOUT, ROWS, ArchivePart
from slamhive.services.configurations import Label
from slamhive.services.executors import Executors
from slamhive.services.experiments.folder import ExperimentFolder
from slamhive.services.experiments.views import ExperimentSource
from slamhive.services.gates import answer_junit, answer_markdown
from slamhive.services.hive import Hive, open_hive
from slamhive.services.imports.request import ImportRequest
from slamhive.services.reindex import reindex, run_folders
from slamhive.services.runs.series import run_series
from slamhive.services.stored_analyses.stored import AnalysisFolder
from slamhive.store import RunRecord
from slamhive.trajectory.kitti import read_kitti
from slamhive.trajectory.layout import read_tum
from slamhive.trajectory.pose_file import TrajectoryFormat, read_image_times
from tests.analysis.test_paper_file import NUMBERS, PAPER
from tests.fuzzing import NASTY_TEXTS, mutated
from tests.services.archive_world import PROTOCOL, make_runs, rewritten, sealed
from tests.services.imports.world import trajectory
from tests.services.test_archive_hostile import members_of
from tests.services.test_published_experiments import FILE
from tests.services.tiny_project import ALGORITHM, environment, make_dataset, make_project

pytestmark = pytest.mark.integration

MUTATIONS = 300
ARCHIVED_RUNS = 2
FILED_RUNS = 30
"""Of which every tenth has failed and has no evaluation."""
MOST_GROWTH_KB = 700_000
"""Of the memory of the process over all mutations of a format."""

EXPERIMENT = """\
name: fuzzed
description: nothing
algorithms: tiny
datasets: track
parameters:
  seconds: 1:3:1 | lin(4, 6, 3)
  behaviour: good
where: seconds >= 2 and seconds != 5
seeds: [1, 2]
repeats: 2
limits: {memory_mb: 500, timeout_s: 60}
stop_when: {lost_tracking_s: 5}
evaluate: {alignment: se3}
executor: process
"""
CONFIGURATION = """\
algorithm: tiny
dataset: track
parameters: {seconds: 1.5}
playback: {mode: realtime, rate: 2.0}
name: n
"""
ANALYSIS = """\
name: An analysis
text: "**bold**"
select:
  good: {runs: [1, 2]}
  rest: {where: "state = succeeded and cpu.mean < 9"}
forms:
  - {form: scatter, x: cpu.mean, y: duration}
  - {form: by_algorithm, metric: ate.rmse}
"""
PROTOCOL_YAML = "alignment: se3\nassociation_tolerance_s: 0.02\nrpe_delta_m: 1.0\nsegment_lengths_m: [5, 10]\n"
_FRAME_ROWS = "".join(f"{100 + k / 10},{k / 10},{k / 10 + 0.03},0\n" for k in range(50))
FRAMES = f"timestamp,received,done,dropped\n{_FRAME_ROWS}"
USAGE = "time,cpu_usage,memory_usage\n" + "".join(f"{k / 10},{1 + k % 3},{1e8 + k}\n" for k in range(50))
TABLE = "algorithm,dataset,trial,file,groundtruth\nalpha,seq1,1,a.txt,truth.txt\nbeta,seq1,1,b.txt,truth.txt\n"
_EUROC_ROWS = "".join(f"{(100 + k) * 10**9},{k},{k * k},0,1,0,0,0\n" for k in range(30))
EUROC = f"#timestamp [ns],x,y,z,qw,qx,qy,qz\n{_EUROC_ROWS}"
KITTI = "".join(f"1 0 0 {k} 0 1 0 {k * k} 0 0 1 0\n" for k in range(30))
RELATIONS = "100 101 0.1 0 0 0 0 0\n101 102.5 0.2 0.1 0 0 0 0\n"
FILTER = "id > 0 and state in (failed, succeeded) and ate.rmse < 0.5 m"
_COVARIANCE = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"
COVARIANCES = "# orientation: body\n" + "".join(f"{100 + k} {_COVARIANCE}\n" for k in range(10))
IMAGES = "# timestamp filename\n" + "".join(f"{100 + k / 10} rgb/{k}.png\n" for k in range(30))
TRIAL = json.dumps(
    {
        "dataset": "track", "files": "0" * 64, "version": 1, "systems": ["a", "b", "c"],
        "runs": {"a": 1, "b": 2, "c": 3},
        "left_out": {"d": "it has no poses"}, "fewest": 3, "why_not": "", "judged_share": 0.9, "start_s": 100.0,
        "stretches": [
            {
                "begin_s": 101.0, "end_s": 102.5, "rms_m": 0.05, "max_m": 0.1, "agreeing": ["a", "b", "c"],
                "differing": [], "ratio": 5.0, "blame": "truth", "because": "it jumps", "confidence": "high",
            }
        ],
        "constants": [{"kind": "lever_arm", "values": [0.1, 0, 0], "sigmas": [0.01] * 3, "agreeing": ["a", "b"]}],
        "leave_out_s": [101.0, 102.5], "times_s": [0.0, 0.5], "residuals_m": {"a": [0.01, None]},
        "common_m": [0.0, None],
    }
)  # fmt: skip
CONFIG = """\
slam-hive-algorithm: tiny
slam-hive-dataset: track
algorithm-parameters: {a: 1}
general-parameter: {b: 2.5}
slam-hive: {run: 1, seed: 2, playback: {mode: realtime, rate: 1.0}}
"""

SENSORS = {"": SensorSetup.LIDAR}

Reader = Callable[[Hive, Path, bytes], object]
"""Reads mutated bytes, with a folder of its own to write them to."""


def written(folder: Path, name: str, data: bytes) -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return path


def text_of(data: bytes) -> str:
    """What a web form or a decoded file hands on."""
    return data.decode("utf-8", "replace")


def read_algorithm(_hive: Hive, folder: Path, data: bytes) -> object:
    written(folder, "tiny/slamhive/mapping.py", b"")
    return load_algorithms(written(folder, "tiny/algorithm.yaml", data).parent)


def read_dataset(_hive: Hive, folder: Path, data: bytes) -> object:
    return load_dataset(written(folder, "track/dataset.yaml", data).parent)


def read_table(hive: Hive, folder: Path, data: bytes) -> object:
    for name in ("a.txt", "b.txt", "truth.txt"):
        (folder / name).write_text(trajectory(1))
    return imported(hive, ImportRequest(written(folder, "t.csv", data), table=True, sensors=SENSORS))


def read_configuration(hive: Hive, _folder: Path, data: bytes) -> object:
    return hive.configurations.import_yaml(text_of(data), "c.yaml", Label())


def read_columns(_hive: Hive, folder: Path, data: bytes) -> object:
    return read_numeric_columns(written(folder, "c.csv", data), ("time", "cpu_usage"), 10**7)


def imported(hive: Hive, request: ImportRequest) -> object:
    """What an import would do; the report names files with a problem, which count as refused here."""
    report = hive.imports.carry_out(request, ignore, dry_run=True)
    for problem in report.problems:
        raise SlamHiveError(problem.text)
    return report


def ignore(*_arguments: object) -> None:
    """Progress that nobody looks at."""


def import_as(kind: TrajectoryFormat) -> Reader:
    """A folder with one trajectory, as an import takes it. The report names problems of single files."""

    def read(hive: Hive, folder: Path, data: bytes) -> object:
        written(folder, "s/seq1/groundtruth.txt", trajectory().encode())
        if kind is TrajectoryFormat.KITTI:
            written(folder, "s/seq1/times.txt", "".join(f"{100 + k / 10}\n" for k in range(30)).encode())
        written(folder, "s/alpha/seq1/1.txt", data)
        return imported(hive, ImportRequest(folder / "s", format=kind, sensors=SENSORS))

    return read


def archived(name: str) -> Reader:
    """A member of an archive whose checksums fit: the import checks the archive as a whole first."""

    def read(hive: Hive, folder: Path, data: bytes) -> object:
        members = sealed({**archive_members(hive), name: data})
        return import_archive(hive, rewritten(folder / "b.zip", members, zipfile.ZIP_STORED))

    return read


def archive_members(hive: Hive) -> dict[str, bytes]:
    return _members_of(hive.settings.data.parent / "a.zip")


_members_of = functools.cache(members_of)


def import_archive(hive: Hive, path: Path) -> object:
    return ArchiveImport(hive.settings, hive.store, hive.catalogue).carry_out(path, ignore)


def read_settings(_hive: Hive, folder: Path, data: bytes) -> object:
    draw = random.Random(data)
    names = draw.sample([entry.environment for entry in describe()], 2)
    return load_settings(folder, {name: draw.choice(NASTY_TEXTS) for name in names})


def read_run_folder(hive: Hive, folder: Path, data: bytes) -> object:
    """What an algorithm leaves behind, file by file the same bytes."""
    run = RunFolder(folder / "run")
    run.create()
    for path in (run.frames, run.profiling, run.playback, run.about, run.trajectory, run.energy, run.progress):
        path.write_bytes(data)
    read_untrusted_json(run.about, 64_000)
    inspect_trajectory(run.trajectory)
    read_profile(run.profiling)
    return run_series(first_run(hive), run)


@functools.cache
def first_run(hive: Hive) -> RunRecord:
    """What the database says of a run does not depend on its files."""
    return hive.runs.get(1)


def zip_of(hive: Hive) -> bytes:
    return (hive.settings.data.parent / "a.zip").read_bytes()


def result_of_a_run(hive: Hive) -> bytes:
    return (hive.runs.folder(1).root / EVALUATION / "result.json").read_bytes()


def member(name: str) -> Callable[[Hive], bytes]:
    return lambda hive: archive_members(hive)[name]


def map_of(hive: Hive) -> bytes:
    path = hive.settings.data.parent / "Map.pcd"
    write_pcd(path, np.random.default_rng(1).normal(size=(50, 3)))
    return path.read_bytes()


def stored_analysis(hive: Hive) -> AnalysisFolder:
    listed = hive.stored_analyses.listed()
    token = listed[0].token if listed else hive.stored_analyses.create(ANALYSIS).token
    return hive.stored_analyses.folder(token)


def read_analysis_state(_hive: Hive, folder: Path, data: bytes) -> object:
    return AnalysisFolder(written(folder, f"{'a' * 32}/state.json", data).parent).read_state()


def read_experiment_record(_hive: Hive, folder: Path, data: bytes) -> object:
    return ExperimentFolder(written(folder, "fuzzed/experiment.json", data).parent).read()


def stored_experiment(hive: Hive) -> bytes:
    if not any(status.name == "fuzzed" for status in hive.experiments.list()):
        hive.experiments.start(ExperimentSource(EXPERIMENT))
    return (hive.settings.experiments_folder / "fuzzed" / "experiment.json").read_bytes()


def stored_baseline(hive: Hive) -> bytes:
    if not hive.gates.baselines.briefs():
        hive.gates.baselines.freeze("fuzzed", "id < 5")
    return (hive.settings.baselines_folder / "fuzzed.json").read_bytes()


def check_gate(hive: Hive, folder: Path, data: bytes) -> object:
    """A baseline from elsewhere, compared with runs that are here and shown."""
    check = hive.gates.prepare(str(written(folder, "b.json", data)))
    found = hive.gates.answer(check, hive.searches.find("id > 105"))
    return found.content, answer_markdown(found), answer_junit(found)


CLAIMS = """\
format: 1
name: fuzzed
title: A table
source: Table 1
within: {ate.rmse: 5%, cpu.mean: 0.1 cores}
obtain: {euroc: fetch it}
claims:
  - algorithm: tiny
    dataset: track
    runs: 5
    parameters: {seconds: 1}
    states: {ate.rmse: 1.6 ± 0.2 cm, cpu.mean: 0.5 cores}
  - {algorithm: tiny, dataset: euroc, version: "1.0", of: median, repeats: 3, protocol: evo, states: {rpe.rmse: 1 mm}}
"""
COMBINATION = FILE.replace("orb-slam3-ros-stereo-inertial", "tiny").replace("nFeatures: 1000 | 2000", "seconds: 1 | 2")
EVALUATION = f"evaluations/{PROTOCOL.fingerprint}"
FORMATS: dict[str, tuple[bytes | Callable[[Hive], bytes], Reader]] = {
    "algorithm.yaml": (ALGORITHM.encode(), read_algorithm),
    "dataset.yaml": (lambda h: (h.settings.datasets_folder / "track/dataset.yaml").read_bytes(), read_dataset),
    "experiment YAML": (EXPERIMENT.encode(), lambda h, _, d: h.experiments.preview(ExperimentSource(text_of(d)))),
    "analysis YAML": (ANALYSIS.encode(), lambda h, _, d: h.analyses.fingerprint(h.analyses.read(text_of(d)))),
    "published analysis YAML": (PAPER.encode(), lambda _h, _f, d: parse_analysis(text_of(d), here=NUMBERS)),
    "published combination": (COMBINATION.encode(), lambda h, _, d: h.experiments.convert(
        ExperimentSource(text_of(d)), {})),
    "protocol YAML": (PROTOCOL_YAML.encode(), lambda _, f, d: load_protocol(written(f, "p.yaml", d))),
    "claims YAML": (CLAIMS.encode(), lambda h, f, d: h.claims.answer(h.claims.read(written(f, "c.yaml", d))).content),
    "configuration YAML": (CONFIGURATION.encode(), read_configuration),
    "config.yaml": (CONFIG.encode(), lambda _, f, d: run_config.load(written(f, "config.yaml", d))),
    "result.json of an engine": (result_of_a_run, lambda _h, _f, d: result_from_json(text_of(d))),
    "experiment.json": (stored_experiment, read_experiment_record),
    "state.json of an analysis": (lambda h: (stored_analysis(h).root / "state.json").read_bytes(), read_analysis_state),
    "baseline of a gate": (stored_baseline, check_gate),
    "archive": (zip_of, lambda h, f, d: import_archive(h, written(f, "b.zip", d))),
    **{f"archive {name}": (member(name), archived(name)) for name in (*ROWS, ABOUT, "runs/1/run.json")},
    "TUM": (trajectory().encode(), lambda _, f, d: read_tum(written(f, "t.txt", d))),
    "TUM import": (trajectory(1).encode(), import_as(TrajectoryFormat.AUTO)),
    "KITTI poses": (KITTI.encode(), lambda _, f, d: read_kitti(
        written(f, "p.txt", d), written(f, "t.txt", "".join(f"{k}\n" for k in range(30)).encode()))),
    "KITTI import": (KITTI.encode(), import_as(TrajectoryFormat.KITTI)),
    "EuRoC import": (EUROC.encode(), import_as(TrajectoryFormat.EUROC)),
    "image times": (IMAGES.encode(), lambda _, f, d: read_image_times(written(f, "rgb.txt", d), (100.0, 103.0))),
    "trial.json": (TRIAL.encode(), lambda _, f, d: TruthTrialDocument.read(read_record(written(f, "trial.json", d)))),
    "relations": (RELATIONS.encode(), lambda _, f, d: read_relations(written(f, "r.txt", d))),
    "covariances": (COVARIANCES.encode(), lambda _, f, d: read_covariances(written(f, "c.txt", d))),
    "import table": (TABLE.encode(), read_table),
    "frames.csv": (FRAMES.encode(), read_run_folder),
    "profiling.csv": (USAGE.encode(), read_run_folder),
    "playback.json": (b'{"sent": 10, "dropped": 1, "lag_s": 0.5, "names": ["a", {"b": [1, 2]}]}', read_run_folder),
    "CSV columns": (USAGE.encode(), read_columns),
    "Map.pcd": (map_of, lambda _, f, d: read_pcd(written(f, "Map.pcd", d), "Map.pcd")),
    "filter": (FILTER.encode(), lambda h, _, d: h.searches.find(text_of(d)[:50_000])),
    "settings": (b"0", read_settings),
}  # fmt: skip


FILES_OF_RUNS = {
    "run.json": "run.json",
    "result.json": f"{EVALUATION}/result.json",
    "protocol.json": f"{EVALUATION}/protocol.json",
    "current protocol": "evaluations/current",
    "traj.tum of an evaluation": f"{EVALUATION}/traj.tum",
    "errors.csv of an evaluation": f"{EVALUATION}/errors.csv",
}
"""Files below the folder of a run, which are read when it is filed."""

LENIENT = {"frames.csv", "profiling.csv", "playback.json", "CSV columns", *FILES_OF_RUNS} - {"run.json"}
"""What cannot be read of these counts as not there: an algorithm, or a killed evaluation, may have left anything."""


@pytest.fixture(scope="module")
def hive(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Hive]:
    """An installation with runs and an experiment, and beside it an archive of all that and of the first runs."""
    root = tmp_path_factory.mktemp("fuzz")
    make_project(root / "project")
    make_dataset(root / "data")
    with pytest.MonkeyPatch.context() as patch:
        for key, value in environment(root / "project", root / "data").items():
            patch.setenv(key, value)
        patch.setattr(Executors, "choose", lambda executors, asked=None: asked or "process")
        hive = open_hive()
        make_runs(hive, ARCHIVED_RUNS)
        stored_experiment(hive)
        stored_analysis(hive)
        small = ExportRequest(root / "a.zip", without=(ArchivePart.TRAJECTORIES, ArchivePart.LOGS))
        export_archive(hive.settings, hive.store, small, ignore)
        make_runs(hive, FILED_RUNS - ARCHIVED_RUNS, first=100)
        yield hive
        hive.close()


@pytest.mark.parametrize("name", FORMATS)
def test_no_mutation_of_a_file_breaks_its_reader(hive: Hive, tmp_path: Path, name: str):
    sample, read = FORMATS[name]
    data = sample if isinstance(sample, bytes) else sample(hive)
    draw = random.Random(name)
    before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    accepted, refused = 0, []
    if name != "settings":
        read(hive, tmp_path, data)  # the sample itself is of this format
    for number in range(MUTATIONS):
        spoiled = mutated(data, draw)
        try:
            read(hive, tmp_path, spoiled)
        except SlamHiveError as error:
            refused.append(str(error))
        except Exception as error:
            error.add_note(f"mutation {number} of {name}: {spoiled[:2000]!r}")
            raise
        else:
            accepted += 1
    print(f"{name}: {accepted} accepted, {len(refused)} refused")  # noqa: T201 - what the report counts
    assert all(text.strip() and "\n" not in text for text in refused)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kb < MOST_GROWTH_KB
    assert bool(refused) == (name not in LENIENT)


@pytest.mark.parametrize("name", FILES_OF_RUNS)
def test_no_mutation_of_a_file_of_a_run_breaks_reindexing(hive: Hive, name: str):
    """The file of every run is spoiled before each reindexing; a folder that cannot be filed is left out in words."""
    folders = run_folders(hive.settings.runs_folder)
    before = {path: path.read_bytes() for each in folders if (path := each.root / FILES_OF_RUNS[name]).exists()}
    draw = random.Random(name)
    refused = []
    for _ in range(0, MUTATIONS, len(before)):
        spoiled = {path: mutated(data, draw) for path, data in before.items()}
        refused += reindexed(hive, folders, spoiled, before)
    print(f"{name}: {len(refused)} refused")  # noqa: T201 - what the report counts
    assert all(text.strip() and "\n" not in text for text in refused)
    assert bool(refused) == (name not in LENIENT)


def reindexed(hive: Hive, folders: list[RunFolder], spoiled: dict[Path, bytes], before: dict[Path, bytes]) -> list[str]:
    """The reasons of what was left out. All folders are read as the page of a run does, and are then as before."""
    for path, data in spoiled.items():
        path.write_bytes(data)
    try:
        report = reindex(hive, ignore)
        records = {run.id: run for run in hive.runs.page(limit=1000).records}
        for folder in folders:
            run_series(records[int(folder.root.name)], folder)
    except Exception as error:
        error.add_note(f"one of these: {[data[:2000] for data in spoiled.values()]!r}")
        raise
    finally:
        for path, data in before.items():
            path.write_bytes(data)
    assert report.runs + len(report.skipped) == len(folders)
    return [reason for _, reason in report.skipped]
