"""Packs the estimated trajectories of an experiment into one small file, and evaluates such a file again.

    python tools/trajectories.py pack algorithms docs/results/trajectories.tar.xz
    python tools/trajectories.py check docs/results/trajectories.tar.xz kitti_06=groundtruth_tum.txt
    python tools/trajectories.py compare docs/results/trajectories.tar.xz docs/results.md

``pack`` reads the data root in force, and takes the runs that the tables of a report count: those that have ended, and
that nothing else disturbed. The same runs give the same bytes. ``check`` computes the error of each trajectory from the
ground truths that it is given, and fails if one differs from what the run was found to have. ``compare`` fails if the
tables of a page do not give the mean errors of these runs.
"""

from __future__ import annotations

import argparse
import io
import json
import sys
import tarfile
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from slamhive.base.errors import InvalidInput, NotFound, SlamHiveError
from slamhive.base.files import write_aside
from slamhive.domain.protocol import protocol_from_content
from slamhive.domain.verdict import VerdictKind
from slamhive.evaluation.job import Artefacts, EvaluationTask
from slamhive.evaluation.references import References
from slamhive.evaluation.work import run_task
from slamhive.services.hive import Hive, open_hive
from slamhive.store import RunRecord

INDEX = "runs.json"
ERROR = "ate_rmse_m"
ATE_COLUMN = 4
"""Of the tables: algorithm, runs, failed, poses, ATE RMSE."""
DECIMALS = 6
SAME_M = 5e-6
"""Errors of the same trajectory differ by less: the archive rounds positions to a millionth of a metre."""


@dataclass(frozen=True, slots=True)
class Packed:
    """One run: what ``runs.json`` says of it, and its trajectory; None if it left none."""

    about: dict[str, Any]
    text: str | None


def main() -> None:
    """Pack or check."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    pack = commands.add_parser("pack")
    pack.add_argument("experiment")
    pack.add_argument("archive", type=Path)
    check = commands.add_parser("check")
    check.add_argument("archive", type=Path)
    check.add_argument("truths", nargs="+", metavar="DATASET=FILE", help="ground truth in TUM format")
    compare = commands.add_parser("compare")
    compare.add_argument("archive", type=Path)
    compare.add_argument("page", type=Path)
    arguments = parser.parse_args()
    try:
        if arguments.command == "pack":
            print(pack_experiment(arguments.experiment, arguments.archive))
        elif arguments.command == "check":
            print(check_archive(arguments.archive, truths_of(arguments.truths)))
        else:
            print(compare_tables(arguments.archive, arguments.page.read_text(encoding="utf-8")))
    except SlamHiveError as error:
        sys.exit(str(error))


def pack_experiment(name: str, target: Path) -> str:
    """Write the archive of an experiment; what it holds, in a line. Raises NotFound and InvalidInput."""
    hive = open_hive()
    try:
        runs = list(collect(hive, name))
    finally:
        hive.close()
    if not runs:
        raise InvalidInput(f"experiment {name} has no run that counts", "wait for its end, or repeat disturbed runs")
    content = archive_of(runs)
    target.parent.mkdir(parents=True, exist_ok=True)
    write_aside(target, content)
    held = sum(entry.text is not None for entry in runs)
    return f"{target}: {len(runs)} runs, {held} trajectories, {len(content) / 1e6:.2f} MB"


def collect(hive: Hive, name: str) -> Iterator[Packed]:
    """The runs of an experiment that count, by dataset and algorithm, and in the order of their repeats."""
    records = [hive.runs.get(number) for number in hive.experiments.run_ids(name)]
    count = Counter[tuple[str, str]]()
    for run in sorted(records, key=lambda entry: (entry.dataset, entry.algorithm, entry.seed, entry.id)):
        if not run.state.ended or (run.disturbance is not None and run.disturbance.disturbed):
            continue
        count[run.dataset, run.algorithm] += 1
        yield packed(hive, run, count[run.dataset, run.algorithm])


def packed(hive: Hive, run: RunRecord, repeat: int) -> Packed:
    """One run, with all that evaluates its trajectory again."""
    path = hive.runs.folder(run.id).trajectory
    algorithm = hive.catalogue.algorithm(run.algorithm)
    sensor = algorithm.assign(hive.catalogue.dataset(run.dataset), run.sensors)[algorithm.trajectory_role]
    text = rounded(path.read_text(encoding="ascii")) if path.is_file() else None
    about = {
        "dataset": run.dataset,
        "algorithm": run.algorithm,
        "repeat": repeat,
        "file": f"{run.dataset}/{run.algorithm}-{repeat}.txt" if text is not None else None,
        "state": run.state.value,
        "reason": None if run.reason is None else run.reason.value,
        "verdict": None if run.judged is None else run.judged.value,
        "poses": run.poses,
        ERROR: (run.metrics or {}).get("ate.rmse"),
        "protocol": hive.evaluations.protocol_of(run).content,
        "T_body_sensor": list(sensor.T_body_sensor),
    }
    return Packed(about, text)


def rounded(text: str) -> str:
    """A trajectory in TUM format with its timestamps as they are, and all other numbers to six decimals."""
    rows = (line.split() for line in text.splitlines() if line.strip() and not line.startswith("#"))
    return "".join(f"{row[0]} {' '.join(f'{float(value):.{DECIMALS}f}' for value in row[1:])}\n" for row in rows)


def archive_of(runs: Iterable[Packed]) -> bytes:
    """The archive; the same runs give the same bytes."""
    entries = list(runs)
    files = {entry.about["file"]: entry.text for entry in entries if entry.text is not None}
    files[INDEX] = json.dumps([entry.about for entry in entries], indent=1) + "\n"
    packed_bytes = io.BytesIO()
    with tarfile.open(fileobj=packed_bytes, mode="w:xz", preset=9, format=tarfile.USTAR_FORMAT) as archive:
        for name in sorted(files):
            content = files[name].encode("ascii")
            member = tarfile.TarInfo(name)
            member.size, member.mode = len(content), 0o644
            archive.addfile(member, io.BytesIO(content))
    return packed_bytes.getvalue()


def read_archive(path: Path) -> list[Packed]:
    """Trajectory that :func:`archive_of` wrote. Raises NotFound and InvalidInput."""
    try:
        with tarfile.open(path, mode="r:xz") as archive:
            files = {name: _text(archive, name) for name in archive.getnames()}
        runs = json.loads(files[INDEX])
        return [Packed(about, files.get(about["file"])) for about in runs]
    except FileNotFoundError:
        raise NotFound(f"{path} does not exist") from None
    except (tarfile.TarError, KeyError, TypeError, ValueError, EOFError) as error:
        raise InvalidInput(
            f"{path} holds no trajectories: {error}", "make it with: tools/trajectories.py pack"
        ) from None


def check_archive(path: Path, truths: Mapping[str, Path]) -> str:
    """Evaluate the trajectories of these datasets; a line that says so. Raises InvalidInput if an error differs."""
    checked = 0
    for entry in read_archive(path):
        about, truth = entry.about, truths.get(entry.about["dataset"])
        if truth is None or entry.text is None or about[ERROR] is None:
            continue
        found_m = error_m(entry, truth)
        if abs(found_m - about[ERROR]) > SAME_M:
            raise InvalidInput(f"{about['file']} has an ATE of {found_m:.6f} m, the run had {about[ERROR]:.6f} m")
        checked += 1
    if not checked:
        raise InvalidInput(f"{path} has no trajectory on {', '.join(truths)} with an error", "name another dataset")
    return f"{checked} trajectories have the error that their runs had"


def error_m(entry: Packed, truth: Path) -> float:
    """The ATE RMSE under the protocol of the run. Raises InvalidInput with the reason if there is none."""
    with tempfile.TemporaryDirectory() as name:
        estimate = Path(name) / "traj.txt"
        estimate.write_text(entry.text or "", encoding="ascii")
        task = EvaluationTask(
            id=entry.about["file"],
            estimate=estimate,
            reference=truth,
            output=Path(name),
            protocol=protocol_from_content(entry.about["protocol"]),
            T_body_sensor=tuple(entry.about["T_body_sensor"]),
            artefacts=Artefacts.METRICS,
        )
        result = run_task(task, References())
    if result.reason is not None:
        raise InvalidInput(f"{entry.about['file']} cannot be evaluated: {result.reason}")
    return result.metrics["ate.rmse"]


def compare_tables(path: Path, page: str) -> str:
    """Compare mean errors with the tables of a page; a line that says so. Raises InvalidInput for the first difference.

    As in the tables, runs that count as failed are not part of a mean.
    """
    runs = [entry.about for entry in read_archive(path)]
    tables = {place: cells[ATE_COLUMN].partition(" ± ")[0] for place, cells in rows_in(page)}
    for (dataset, algorithm), text in tables.items():
        own = [about for about in runs if (about["dataset"], about["algorithm"]) == (dataset, algorithm)]
        errors_m = [about[ERROR] for about in own if about["verdict"] == VerdictKind.GOOD and about[ERROR] is not None]
        mean_m = sum(errors_m) / len(errors_m) if errors_m else None
        decimals = len(text.partition(".")[2])
        found = "–" if mean_m is None else f"{mean_m:.{decimals}f}"
        if found != text:
            raise InvalidInput(f"{algorithm} on {dataset}: the page has {text} m, the runs have {found} m")
    if len(tables) != len({(about["dataset"], about["algorithm"]) for about in runs}):
        raise InvalidInput("the page and the archive do not have the same algorithms", "make both from one experiment")
    return f"{len(tables)} mean errors are those of the page"


def rows_in(page: str) -> Iterator[tuple[tuple[str, str], list[str]]]:
    """Dataset and algorithm, then all cells, of each row of the tables of a page."""
    dataset = ""
    for line in page.splitlines():
        dataset = line.strip("# `") if line.startswith("## ") else dataset
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("| `") and len(cells) > ATE_COLUMN:
            yield (dataset, cells[0].strip("`")), cells


def truths_of(texts: Iterable[str]) -> dict[str, Path]:
    """``DATASET=FILE`` as a mapping. Raises InvalidInput and NotFound."""
    found: dict[str, Path] = {}
    for text in texts:
        name, equals, file = text.partition("=")
        if not equals or not name:
            raise InvalidInput(f"{text!r} names no ground truth", "write DATASET=FILE")
        if not Path(file).is_file():
            raise NotFound(f"{file} does not exist", "name the ground truth of the dataset in TUM format")
        found[name] = Path(file)
    return found


def _text(archive: tarfile.TarFile, name: str) -> str:
    stream = archive.extractfile(name)
    if stream is None:
        raise InvalidInput(f"{name} is no file")
    return stream.read().decode("ascii")


if __name__ == "__main__":
    main()
