"""``slamhive dataset``: import, render, list, show, remove; other commands have modules of their own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slamhive.cli import completion
from slamhive.cli.context import CliContext, json_option, pass_cli
from slamhive.cli.main import LazyGroup
from slamhive.cli.output import print_json, print_table, progress_bar, tell
from slamhive.cli.visible import say
from slamhive.documents.catalogue import DatasetCheck, FindingDocument
from slamhive.domain.dataset import Dataset, Severity

if TYPE_CHECKING:
    from slamhive.services.datasets import PlannedImport


# Exporters load OpenCV, and no list of datasets should wait for it.
_ELSEWHERE = dict.fromkeys(("fetch", "search", "links", "export"), "dataset_transfer")


@click.group(cls=LazyGroup, modules=_ELSEWHERE)
def dataset() -> None:
    """Fetch, import, export, render and show datasets."""


@dataset.command("import", short_help="Make a dataset of the recording at PATH")
@click.argument("source", metavar="PATH", type=click.Path(path_type=Path))
@click.option("--name", help="Name of the new dataset.  [default: that of PATH]")
@click.option("--format", "format_name", help="Format of PATH.  [default: detected]")
@click.option("--groundtruth", type=click.Path(path_type=Path), help="Ground truth: a TUM or EuRoC file.")
@click.option("--groundtruth-topic", help="Topic that holds the ground truth; TOPIC:FRAME of a transform.")
@click.option(
    "--calibration",
    type=click.Path(path_type=Path),
    multiple=True,
    help="Calibration: Kalibr's camchain.yaml or imu.yaml, or a dataset.yaml. Can be given several times.",
)
@click.option(
    "--topic",
    "topics",
    metavar="SENSOR=TOPIC",
    multiple=True,
    help="Topic of a sensor, for instance cam0=/left; none leaves it out.",
)
@click.option("--typestore", help="Message types of a recording that does not contain them, for instance ros2_humble.")
@click.option(
    "--msgs",
    "message_definitions",
    type=click.Path(path_type=Path),
    help="Folder of .msg files for types that are not defined.",
)
@click.option("--depth-units-per-m", type=float, help="Value of a depth pixel that means one metre, for instance 5000.")
@click.option(
    "--frame-rate",
    "frame_rate_hz",
    type=float,
    metavar="HZ",
    help="Frames per second, where the format stores no timestamps.",
)
@click.option("--sequence", help="Sequence, where PATH holds several.")
@click.option(
    "--uncertainty",
    "uncertainty_m",
    type=float,
    metavar="M",
    help="Standard deviation of the ground truth's positions along each axis.",
)
@click.option("--accept-loss", is_flag=True, help="Import the rest where over 1 % of the messages are lost.")
@click.option("--preview", is_flag=True, help="Show what would be made, and stop.")
@json_option
@pass_cli
def import_(
    cli: CliContext, source: Path, name: str | None, format_name: str | None, preview: bool, as_json: bool, **given: Any
) -> None:
    """Make a dataset of the recording at PATH: a file or a folder, its format is detected."""
    # Lists need neither importers nor OpenCV.
    from slamhive.recordings.importing import ImportOptions, read_topics  # noqa: PLC0415

    catalogue = cli.hive(indexed=False).catalogue
    given["topics"] = read_topics(given["topics"])
    planned = catalogue.plan_import(source, ImportOptions(**given), format_name=format_name, name=name)
    if preview and as_json:
        print_json(planned.content)
        return
    if not as_json:
        _show_plan(planned)
    if preview:
        return
    with progress_bar(f"importing {planned.name}") as progress:
        made = catalogue.import_dataset(planned, progress)
    if as_json:
        _report(made, as_json)
    else:
        tell(f"dataset {made.name} is ready: slamhive run ALGORITHM {made.name} --evaluate --wait")


def _show_plan(planned: PlannedImport) -> None:
    plan, truth = planned.plan, planned.plan.truth
    doubt = f" (experimental: {planned.experimental})" if planned.experimental else ""
    say(f"{planned.name}: {planned.format}{doubt}, {plan.duration_s:.1f} s, about {plan.needed_bytes / 1e6:.0f} MB")
    if truth is None:
        words = "none" if plan.relations is None else "relations"
    else:
        kind = "positions" if truth.quats_xyzw is None else "poses"
        words = f"{len(truth.times_s)} {kind}{', ' if truth.source else ''}{truth.source}"
    say(f"ground truth: {words}")
    rows = [
        (sensor.name, sensor.kind.value, sensor.topic, plan.counts[sensor.name], f"{sensor.rate_hz:g}")
        for sensor in plan.sensors
    ]
    print_table(("sensor", "kind", "topic", "messages", "rate Hz"), rows, right=("messages", "rate Hz"))
    for note in plan.notes:
        tell(f"note: {note}")


@dataset.command("room", short_help="Render the synthetic room with exact ground truth")
@click.option("--name", default="room", show_default=True, help="Name of the new dataset.")
@click.option("--seconds", type=float, default=15.0, show_default=True, help="Duration in s.")
@click.option("--seed", type=int, default=1, show_default=True, help="The same seed gives the same bytes.")
@json_option
@pass_cli
def room(cli: CliContext, name: str, seconds: float, seed: int, as_json: bool) -> None:
    """Render the synthetic room: stereo, depth, IMU, LiDAR and exact ground truth."""
    from slamhive.recordings.room import RoomOptions  # noqa: PLC0415

    options = RoomOptions(name=name, duration_s=seconds, seed=seed)
    with progress_bar(f"rendering {name}") as progress:
        made = cli.hive(indexed=False).catalogue.render_room(options, progress)
    _report(made, as_json)


@dataset.command("list")
@json_option
@pass_cli
def list_(cli: CliContext, as_json: bool) -> None:
    """List all datasets."""
    hive = cli.hive(indexed=False)
    catalogue, numbers = hive.catalogue, hive.numbers().of_datasets
    found = catalogue.datasets()
    if as_json:
        print_json([{**_to_json(entry), "number": numbers.get(entry.name)} for entry in found])
        return
    if not found:
        tell("no datasets yet; `slamhive dataset room` renders one")
    else:
        rows = [
            (
                numbers.get(entry.name),
                entry.name,
                f"{entry.duration_s:.1f}",
                ", ".join(f"{sensor.name} {sensor.rate_hz:g} Hz" for sensor in entry.sensors),
                _ground_truth(entry),
            )
            for entry in found
        ]
        print_table(("no.", "name", "duration s", "sensors", "ground truth"), rows, right=("no.", "duration s"))
    for broken in catalogue.broken():
        tell(f"left out: {broken.problem}")


def plot_option(draws: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """``--plot FILE``, whose help begins with what it draws."""
    file = click.Path(path_type=Path, dir_okay=False)
    return click.option("--plot", "picture", metavar="FILE", type=file, help=f"{draws} (.png, .svg or .pdf).")


@dataset.command("show", short_help="Show one dataset: sensors, calibration, ground truth")
@click.argument("name", shell_complete=completion.DATASET)
@plot_option("Draw path, speed and angular rate of the ground truth")
@json_option
@pass_cli
def show(cli: CliContext, name: str, picture: Path | None, as_json: bool) -> None:
    """Show one dataset: sensors, calibration, ground truth and its motion."""
    from slamhive.services.datasets import draw_ground_truth, motion_summary  # noqa: PLC0415 - loads OpenCV

    entry = cli.hive(indexed=False).catalogue.dataset(name)
    exists = entry.groundtruth_path is not None and entry.groundtruth_path.is_file()
    motion = motion_summary(entry) if exists else None
    if as_json:
        print_json({**_to_json(entry), "motion": None if motion is None else asdict(motion)})
    else:
        _report(entry, as_json)
        if motion is not None:
            words = [f"path: {motion.length_m:.4g} m in {motion.span_s:.1f} s"]
            if motion.mean_speed_mps is not None:
                words.append(f"{motion.mean_speed_mps:.3g} m/s on average")
            if motion.max_speed_mps is not None:
                words.append(f"{motion.max_speed_mps:.3g} m/s at most")
            if motion.max_angular_rate_radps is not None:
                words.append(f"turning at {motion.max_angular_rate_radps:.3g} rad/s at most")
            say(", ".join(words))
        say()
        print_table(("sensor", "calibration", "value"), _calibration(entry))
    if picture is not None:
        draw_ground_truth(entry, picture)
        tell(f"wrote {picture}")


@dataset.command("remove", short_help="Delete a dataset and its variants; runs keep their results")
@click.argument("name", shell_complete=completion.DATASET)
@click.confirmation_option(prompt="Delete the dataset's folder? Runs keep their results.")
@pass_cli
def remove(cli: CliContext, name: str) -> None:
    """Delete a dataset and its variants; runs that used it keep their results."""
    hive = cli.hive(indexed=False)
    hive.catalogue.remove_dataset(name)
    hive.variants.drop_unused(name)
    tell(f"dataset {name} removed")


def _to_json(entry: Dataset) -> dict[str, Any]:
    from slamhive.services.datasets import dataset_document  # noqa: PLC0415 - a plain list has no documents

    return {**dataset_document(entry).content, "folder": str(entry.folder)}


def _report(entry: Dataset, as_json: bool) -> None:
    if as_json:
        print_json(_to_json(entry))
        return
    say(f"{entry.name}: {entry.duration_s:.1f} s, {entry.bag_path if entry.bag else 'no recording'}")
    for label, text in (
        ("title", entry.title),
        ("attributes", ", ".join(entry.attributes)),
        ("licence", entry.licence),
        ("citation", entry.citation),
        ("ground truth", _ground_truth_in_words(entry)),
        ("relations", entry.relations),
    ):
        if text:
            say(f"{label}: {text}")
    rows = [(s.name, s.kind.value, s.topic, f"{s.rate_hz:g}") for s in entry.sensors]
    print_table(("sensor", "kind", "topic", "rate Hz"), rows, right=("rate Hz",))


def _calibration(entry: Dataset) -> list[tuple[str, str, str]]:
    return [
        (sensor.name, key, ", ".join(f"{number:.6g}" for number in value) if isinstance(value, tuple) else str(value))
        for sensor in entry.sensors
        for key, value in (*sensor.calibration.items(), ("T_body_sensor", sensor.T_body_sensor))
    ]


def _ground_truth(entry: Dataset) -> str:
    if entry.groundtruth_path is None:
        return "no" if entry.relations is None else "relations"
    return "yes" if entry.groundtruth_path.is_file() else "file missing"


def _ground_truth_in_words(entry: Dataset) -> str:
    truth = entry.groundtruth
    if truth is None:
        return "none" if entry.relations is None else "no trajectory"
    traits = (
        "" if entry.groundtruth_path is not None and entry.groundtruth_path.is_file() else "the file is missing",
        "z axis up" if truth.gravity_aligned else "z axis not known to point up",
        "positions only" if truth.positions_only else "",
        "" if truth.lever_arm_m is None else f"lever arm {' '.join(f'{m:g}' for m in truth.lever_arm_m)} m",
        "" if truth.uncertainty_m is None else f"uncertainty {truth.uncertainty_m:g} m",
        "" if truth.uncertainties is None else f"uncertainty of each pose in {truth.uncertainties}",
    )
    return f"{truth.file}, {', '.join(trait for trait in traits if trait)}"


# ``slamhive dataset check``: what is wrong with a dataset, and what to do about it.


@click.command("check", short_help="Check recording, calibration and ground truth of a dataset")
@click.argument("name", shell_complete=completion.DATASET)
@click.option("--strict", is_flag=True, help="Exit code 1 for warnings too.")
@json_option
@pass_cli
def check(cli: CliContext, name: str, strict: bool, as_json: bool) -> None:
    """Check the recording, the calibration and the ground truth of dataset NAME.

    Reads the recording once. The exit code is 1 if there is an error, with --strict also if there is a warning; else 0.
    """
    hive = cli.hive(indexed=False)
    entry = hive.catalogue.dataset(name)
    with progress_bar(f"checking {name}") as progress:
        report = hive.dataset_checks.check(entry, progress)
    if as_json:
        print_json(report.content)
    else:
        _print(report)
    bad = report.count(Severity.ERROR) + (report.count(Severity.WARNING) if strict else 0)
    if bad:
        raise click.exceptions.Exit(1)


def _print(report: DatasetCheck) -> None:
    """One line for each finding, however long: terminals wrap it, and ``grep`` finds all of it."""
    width = max([len(finding.check) for finding in report.findings], default=0)
    for finding in report.findings:
        place = f"{finding.severity.value:8}{finding.check:{width}}  {finding.about}, {_where(finding)}"
        say(f"{place}: {finding.message} To do: {finding.remedy}.")
    counts = ", ".join(f"{report.count(severity)} {severity.value}s" for severity in Severity)
    tell(f"{report.dataset}: {counts}; {len(report.checks)} checks")
    if report.not_checked:
        tell(f"{len(report.not_checked)} could not be done; --json says why")


def _where(finding: FindingDocument) -> str:
    if finding.at_s is None:
        return "everywhere"
    return f"{finding.at_s:.2f} s" + (f" and {finding.count - 1} more" if finding.count > 1 else "")


@click.command("trial", short_help="Hold the ground truth of a dataset against its runs")
@click.argument("name", shell_complete=completion.DATASET)
@plot_option("Draw the residuals of all systems over time")
@json_option
@pass_cli
def trial(cli: CliContext, name: str, picture: Path | None, as_json: bool) -> None:
    """Find where systems with good runs on dataset NAME agree with each other and contradict its ground truth.

    One run stands for each system: that with the median error. Three systems are needed. The exit code is 0 whatever is
    found.
    """
    from slamhive.services.datasets import constant_in_words, draw_trial, stretch_in_words  # noqa: PLC0415 - numpy

    hive = cli.hive()
    found = hive.truth_trials.judge(hive.catalogue.dataset(name))
    if picture is not None:
        draw_trial(found, picture)
    if as_json:
        print_json(found.content)
        return
    for system, reason in found.left_out.items():
        tell(f"{system} takes no part: {reason}")
    if found.why_not:
        say(f"{name}: no verdict, {found.why_not}")
        return
    systems = ", ".join(f"{system} (run {found.runs[system]})" for system in found.systems)
    say(f"{name}: {systems}; {found.judged_share:.0%} of the time is judged")
    for entry in found.stretches:
        say(stretch_in_words(found, entry))
    for constant in found.constants:
        say(constant_in_words(constant))
    if not found.stretches and not found.constants:
        say("Nothing contradicts the ground truth.")
    if found.stretches:
        stretches = ", ".join(f"{second:.3f}" for second in found.leave_out_s)
        tell(f"to leave them out, evaluate under a protocol with leave_out_s: [{stretches}]")
    if picture is not None:
        tell(f"wrote {picture}")


dataset.add_command(check)
dataset.add_command(trial)
COMMANDS = (dataset,)
"""Commands of the group ``dataset``."""
