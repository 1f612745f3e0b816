"""``slamhive runs import``: import trajectories as runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from slamhive.base.errors import InvalidInput
from slamhive.cli.context import CliContext, choice, json_option, pass_cli
from slamhive.cli.output import hints_of, print_hints, print_json, progress_bar, tell
from slamhive.cli.visible import say
from slamhive.cli.waiting import evaluate_to_end
from slamhive.documents.imports import Import
from slamhive.domain.names import plural
from slamhive.domain.protocol import Duplicates, TrajectoryKind
from slamhive.domain.sensors import SensorSetup
from slamhive.services.imports import (
    DEFAULT_GROUND_TRUTH,
    DEFAULT_IMAGE_TIMES,
    DEFAULT_PATTERN,
    DEFAULT_RELATIONS,
    DEFAULT_TIMES,
    ImportReport,
    ImportRequest,
    Reading,
    TrajectoryFormat,
    parse_setup,
)
from slamhive.trajectory.layout import Convention, QuaternionOrder, TimeUnit

_SHOWN_LEFT_OUT = 10
_DUPLICATES_HELP = "Which poses count where a timestamp occurs twice; the runs are evaluated so."
_SENSORS_HELP = f"What an algorithm senses with: {', '.join(SensorSetup)}. Without a name: all others."


@click.command("import")
@click.argument("source", type=click.Path(path_type=Path))
@click.option("--table", is_flag=True, help="SOURCE is a CSV: algorithm,dataset,trial,file[,sensors,groundtruth,...].")
@click.option("--pattern", default=DEFAULT_PATTERN, show_default=True, help="Path pattern of trajectories.")
@click.option("--groundtruth", default=DEFAULT_GROUND_TRUTH, show_default=True, help="Path pattern of ground truths.")
@click.option("--relations", default=DEFAULT_RELATIONS, show_default=True, help="Path pattern of relations.")
@click.option(
    "--times",
    default=DEFAULT_TIMES,
    show_default=True,
    help="Path pattern of timestamps of poses without, such as KITTI's.",
)
@click.option(
    "--image-times",
    default=DEFAULT_IMAGE_TIMES,
    show_default=True,
    help="Path pattern of times of images, at which protocols such as eth3d compare.",
)
@click.option("--format", "wanted", type=choice(TrajectoryFormat), default="auto", show_default=True)
@click.option(
    "--columns", metavar="NAMES", help="Columns of trajectories, such as t,x,y,z,qw,qx,qy,qz; detected by default."
)
@click.option("--sensors", multiple=True, metavar="[NAME=]SETUP", help=_SENSORS_HELP)
@click.option("--time-unit", type=choice(TimeUnit), help="Unit of the timestamps; detected by default.")
@click.option("--quaternion-order", type=choice(QuaternionOrder), help="Order of the quaternions; detected by default.")
@click.option("--groundtruth-time-unit", type=choice(TimeUnit), help="Unit of the ground truths' timestamps.")
@click.option(
    "--groundtruth-quaternion-order", type=choice(QuaternionOrder), help="Order of the ground truths' quaternions."
)
@click.option("--duplicates", type=choice(Duplicates), default="refuse", show_default=True, help=_DUPLICATES_HELP)
@click.option("--trajectory", type=choice(TrajectoryKind), help="Which trajectory the files are; stored with the runs.")
@click.option("--gravity-aligned", is_flag=True, help="The z axis of the ground truth points up.")
@click.option("--evaluate/--no-evaluate", default=True, show_default=True, help="Evaluate runs without an evaluation.")
@click.option("--dry-run", is_flag=True, help="Read and check everything, write nothing.")
@json_option
@pass_cli
def import_runs(cli: CliContext, /, source: Path, dry_run: bool, as_json: bool, **options: Any) -> None:
    """Import trajectories from SOURCE, a folder or a table.

    The unit of timestamps and the order of quaternions are detected and reported. An ambiguous file is refused; the
    message names the option that decides.

    Poses are those of the body, in the frame of the ground truth. Running the command again imports new files and
    completes an interrupted import.
    """
    hive = cli.hive()
    request = ImportRequest(
        source=source,
        table=options["table"],
        pattern=options["pattern"],
        ground_truth=options["groundtruth"],
        relations=options["relations"],
        times=options["times"],
        image_times=options["image_times"],
        format=TrajectoryFormat(options["wanted"]),
        sensors=_sensors(options["sensors"]),
        gravity_aligned=options["gravity_aligned"],
        told=_convention(options, ""),
        truth_told=_convention(options, "groundtruth_"),
        duplicates=Duplicates(options["duplicates"]),
        columns=options["columns"],
        trajectory=TrajectoryKind(options["trajectory"]) if options["trajectory"] else None,
    )
    with progress_bar("reading" if dry_run else "importing") as show:
        report = hive.imports.carry_out(
            request, lambda done, total: show(done / total, f"{done}/{total} trajectories"), dry_run=dry_run
        )
    wanted = hive.evaluations.unsettled(report.run_ids) if options["evaluate"] else []
    ended = evaluate_to_end(hive.evaluations, hive.evaluations.queue(wanted))
    failures = {record.run_id: record.reason for record in ended if record.reason is not None}
    evaluated = len(ended) - len(failures)
    hints = hints_of(hive, ended)
    if as_json:
        print_json(Import.of(report, evaluated=evaluated, failed_evaluations=failures, hints=hints).content)
    else:
        _show(report, evaluated, failures)
        print_hints(hints)
    if report.problems or failures:
        raise click.exceptions.Exit(1)


def _convention(options: dict[str, Any], prefix: str) -> Convention:
    """Return what the options say of trajectories, or with a prefix of ground truths."""
    unit, order = options[f"{prefix}time_unit"], options[f"{prefix}quaternion_order"]
    return Convention(None if unit is None else TimeUnit(unit), None if order is None else QuaternionOrder(order))


def _sensors(texts: tuple[str, ...]) -> dict[str, SensorSetup]:
    """``NAME=SETUP`` texts by name, "" for one without; raises InvalidInput for a name given twice."""
    setups: dict[str, SensorSetup] = {}
    for text in texts:
        name, _, setup = text.rpartition("=")
        if name in setups:
            raise InvalidInput(f"--sensors for {name or 'all others'} is given twice")
        setups[name] = parse_setup(setup)
    return setups


def _show(report: ImportReport, evaluated: int, failures: dict[int, str]) -> None:
    """Print what was done on stdout, and problems on stderr."""
    for problem in report.problems:
        tell(f"{problem.name}: {problem.text}")
    for run_id, reason in failures.items():
        tell(f"run {run_id} cannot be evaluated: {reason}")
    # A line for each way in which files were read that are not TUM files with poses, with the reasons of one.
    alike: dict[str, list[Reading]] = {}
    for reading in report.readings:
        if not reading.as_it_stands or "orientation" in reading.because:
            alike.setdefault(reading.words, []).append(reading)
    for read, members in alike.items():
        first = members[0]
        files = f"{first.name} was" if len(members) == 1 else f"{len(members):,} files, the first {first.name}, were"
        tell(f"{files} {read}. " + " ".join(f"{_WHAT[key]}: {because}." for key, because in first.because.items()))
    if report.left_out:
        shown = ", ".join(report.left_out[:_SHOWN_LEFT_OUT])
        more = f" and {len(report.left_out) - _SHOWN_LEFT_OUT} more" if len(report.left_out) > _SHOWN_LEFT_OUT else ""
        tell(f"skipped because they match no pattern: {shown}{more}")
    would = "would be " if report.dry_run else ""
    words = [f"{plural(report.imported, 'run')} {would}imported", f"{report.known:,} known already"]
    words += [f"{plural(len(report.datasets), 'dataset')} {would}made of ground truth"] if report.datasets else []
    words += [] if report.dry_run else [f"{evaluated:,} evaluated"]
    words += [plural(len(report.problems), "problem")] if report.problems else []
    words += [f"{plural(len(failures), 'evaluation')} failed"] if failures else []
    say(", ".join(words))


_WHAT = {"time_unit": "Unit", "quaternion_order": "Order", "orientation": "Orientation"}


COMMANDS = (import_runs,)
