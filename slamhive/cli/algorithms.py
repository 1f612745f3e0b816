"""``slamhive algorithm``: list, show, build; ``test`` and versions have modules of their own."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slamhive.base.errors import InvalidInput, NotFound, SlamHiveError
from slamhive.cli import completion
from slamhive.cli.context import CliContext, choice, json_option, pass_cli
from slamhive.cli.output import print_json, print_table, tell
from slamhive.cli.visible import say, write_out
from slamhive.domain.algorithm import Algorithm
from slamhive.domain.names import plural
from slamhive.domain.parameters import Parameter
from slamhive.domain.sensors import SensorSetup

if TYPE_CHECKING:
    from slamhive.documents.catalogue import BoundResult
    from slamhive.services.algorithms import PlannedPackage
    from slamhive.services.hive import Hive


@click.group()
def algorithm() -> None:
    """List, show, build and test algorithms; list, verify and move their versions."""


@algorithm.command("list")
@json_option
@pass_cli
def list_(cli: CliContext, as_json: bool) -> None:
    """List all algorithms and whether they are built."""
    hive = cli.hive(indexed=False)
    executor = hive.executors.get(hive.executors.choose())
    identities: dict[str, str | None] = {}
    problems: dict[str, str] = {}
    for package in hive.catalogue.packages():
        try:
            identities[package.name] = executor.identity(package)
        except SlamHiveError as error:
            identities[package.name] = None
            problems[package.name] = str(error)
    found = hive.catalogue.algorithms()
    numbers = hive.numbers().of_algorithms
    if as_json:
        print_json([{**_json(entry, identities), "number": numbers.get(entry.name)} for entry in found])
        return
    rows = [
        (
            numbers.get(entry.name),
            entry.name,
            entry.title,
            entry.package.version,
            entry.package.short_licence,
            "not available" if entry.package.name in problems else _state(entry, identities[entry.package.name]),
        )
        for entry in found
    ]
    columns = ("no.", "name", "title", "version", "licence", f"for {executor.name}")
    print_table(columns, rows, right=("no.",), cut=("title", "licence"))
    for name, problem in problems.items():
        tell(f"{name} is not available: {problem}")
    for broken in hive.catalogue.broken():
        tell(f"left out: {broken.problem}")


@algorithm.command("show", short_help="Show one algorithm: needs and parameters")
@click.argument("name", shell_complete=completion.ALGORITHM)
@json_option
@pass_cli
def show(cli: CliContext, name: str, as_json: bool) -> None:
    """Show one algorithm: what it needs, and its parameters with type, default, range and unit."""
    entry = cli.hive(indexed=False).catalogue.algorithm(name)
    if as_json:
        from slamhive.documents.catalogue import AlgorithmDocument  # noqa: PLC0415 - tables need no model

        print_json(AlgorithmDocument.of(entry).content)
        return
    say(f"{entry.name}: {entry.title} ({entry.package.title} {entry.package.version}, {entry.package.licence})")
    say(f"needs {', '.join(f'{i.role} ({i.kind})' for i in entry.inputs)}; {entry.package.upstream}")
    if entry.pose_time is not None:
        say(f"a pose describes {entry.trajectory_role} {entry.pose_time.words}")
    if entry.package.origin is not None:
        say(f"imported from {entry.package.origin.words}; runs are {entry.package.user.in_words}")
    for topic in entry.topics:
        say(f"{topic.role}: {topic.words}")
    if entry.unknown:
        say(f"not known: {', '.join(entry.unknown)}; fill in {entry.package.folder / 'algorithm.yaml'}")
    rows = [(p.key, _default(p), p.expectation, p.general, p.help) for p in entry.parameters]
    print_table(("parameter", "default", "expected", "general name", "help"), rows, right=("default",))
    for bound in entry.bounds:
        say(f"on {bound.dataset}: {bound.words}")


@algorithm.command("build", short_help="Build the images of algorithms")
@click.argument("names", nargs=-1, shell_complete=completion.PACKAGE)
@click.option("--all", "all_", is_flag=True, help="Build all packages.")
@click.option("--executor", help="An executor that `slamhive doctor --all` lists; default: the one in force.")
@pass_cli
def build(cli: CliContext, names: tuple[str, ...], all_: bool, executor: str | None) -> None:
    """Build the images (for the process executor: the environments) of the algorithms or packages NAMES."""
    if bool(names) == all_:
        raise InvalidInput("name the algorithms to build, or give --all", "slamhive algorithm list shows them")
    hive = cli.hive()
    hive.check_writable()
    packages = hive.catalogue.packages() if all_ else {hive.catalogue.package(name) for name in names}
    chosen = hive.executors.get(hive.executors.choose(executor))
    failures: list[SlamHiveError] = []
    for package in sorted(packages, key=lambda entry: entry.name):
        tell(f"building {package.name} for {chosen.name}", style="bold")
        try:
            identity = chosen.build(package, _each_once(lambda line: tell(line, style="dim")))
        except SlamHiveError as error:
            failures.append(error)
            tell(f"error: {error}", style="red")
        else:
            record = hive.versions.register(chosen, package, identity)
            say(f"{record.label}: {identity}")
    if failures:
        raise click.exceptions.Exit(1)


def _each_once(show: Callable[[str], None]) -> Callable[[str], None]:
    """``show``, but not for a line that comes again while a program says nothing."""
    last = ""

    def line(text: str) -> None:
        nonlocal last
        if text != last:
            last = text
            show(text)

    return line


def _json(entry: Algorithm, identities: Mapping[str, str | None]) -> dict[str, Any]:
    from slamhive.documents.catalogue import AlgorithmDocument  # noqa: PLC0415 - tables need no model

    return {**AlgorithmDocument.of(entry).content, "identity": identities[entry.package.name]}


def _state(entry: Algorithm, identity: str | None) -> str:
    if entry.package.origin is not None:
        return "imported" if identity else "imported, but its image is gone"
    return "built" if identity else "not built"


def _default(parameter: Parameter) -> str:
    if parameter.source is not None:
        return f"from {parameter.source}"
    return "must be given" if parameter.must_be_given else _text(parameter.default)


def _text(value: Any) -> str:
    return ", ".join(f"{number:g}" for number in value) if isinstance(value, tuple) else str(value)


# ``slamhive algorithm import`` and ``remove``.


@click.command("import", short_help="Import an algorithm of the published system")
@click.argument("source", metavar="FOLDER|GIT-URL|IMAGE|TAR")
@click.option("--name", help="The name of the package; default: that of the source.")
@click.option("--image", help="The image to use with a folder: its name, or a file that docker save wrote.")
@click.option("--setup", type=choice(SensorSetup), help="What the algorithm senses with, if its files do not say.")
@click.option("--replace", is_flag=True, help="Take the place of an imported package of that name.")
@click.option("--executor", help="The executor that gets the image; default: the one in force.")
@click.option("--preview", is_flag=True, help="Only show what would be made.")
@json_option
@pass_cli
def import_(cli: CliContext, source: str, preview: bool, as_json: bool, **asked: Any) -> None:
    """Import an algorithm that was made for the published SLAM Hive, without changing its files, or a package.

    FOLDER holds slamhive/mapping.py, and a Dockerfile or image.tar. A Git address may end with #COMMIT. IMAGE and TAR
    hold /slamhive themselves; TAR may also be what `slamhive algorithm export` wrote. `algorithm.yaml` is drafted from
    the files, which are read and not executed; a folder that has one is a package, which is copied and built as it is.
    """
    # Importing the services takes half a second, which `--help` need not wait for.
    from slamhive.services.algorithms import PackageImportRequest  # noqa: PLC0415
    from slamhive.services.versions import is_export  # noqa: PLC0415

    hive = cli.hive(indexed=False)
    if is_export(Path(source)):
        chosen = hive.executors.get(hive.executors.choose(asked["executor"]))
        loaded, record = hive.versions.load(Path(source), chosen)
        say(f"{record.label}: {loaded.package.folder}")
        return
    setup = asked.pop("setup")
    request = PackageImportRequest(setup=None if setup is None else SensorSetup(setup), **asked)
    with hive.algorithms.planned(source, request) as planned:
        if preview:
            _show_plan(planned, as_json=as_json)
            return
        tell(f"{planned.name}: {_way(planned)}", style="bold")
        made = hive.algorithms.perform(planned, lambda line: tell(line, style="dim"))
    for note in made.notes:
        tell(f"note: {note}")
    if as_json:
        from slamhive.documents.catalogue import AlgorithmDocument  # noqa: PLC0415 - tables need no model

        print_json([AlgorithmDocument.of(entry).content for entry in made.algorithms])
        return
    package = made.algorithms[0].package
    say(f"imported {', '.join(entry.name for entry in made.algorithms)}; check {package.folder / 'algorithm.yaml'}")


@click.command("remove")
@click.argument("name", shell_complete=completion.PACKAGE)
@click.option("--executor", help="The executor that has the image; default: the one in force.")
@pass_cli
def remove(cli: CliContext, name: str, executor: str | None) -> None:
    """Remove the imported package NAME and its image. Runs keep their results."""
    left = cli.hive(indexed=False).algorithms.remove(name, executor)
    if left is not None:
        tell(f"note: {left}")
    say(f"{name} is removed")


def _way(planned: PlannedPackage) -> str:
    verbs = {"build": "builds", "load": "loads", "take": "takes"}
    return f"{verbs[planned.way.value]} {planned.image} ({planned.why})"


def _show_plan(planned: PlannedPackage, *, as_json: bool) -> None:
    if as_json:
        print_json(planned.content)
        return
    say(f"{planned.name} from {planned.origin.words}")
    say(_way(planned))
    if planned.text is None:
        say("algorithm.yaml is drafted when the image is there")
        return
    write_out(planned.text)
    for note in () if planned.draft is None else planned.draft.notes:
        tell(f"note: {note}")


# ``slamhive algorithm test``: whether packages keep what they promise, on this machine.


COLUMNS = (
    *("algorithm", "dataset", "run", "poses", "at least", "ATE m", "at most", "relations m", "at most"),
    *("relations deg", "at most", "ms per frame", "RAM MB", "result"),
)


@click.command("test", short_help="Test if algorithms keep their bounds")
@click.argument("names", nargs=-1, shell_complete=completion.PACKAGE)
@click.option("--all", "all_", is_flag=True, help="Test all packages.")
@click.option("--dataset", "datasets", multiple=True, help="Only the bounds on these datasets.")
@click.option("--executor", help="An executor that `slamhive doctor --all` lists; default: the one in force.")
@json_option
@pass_cli
def test(
    cli: CliContext, names: tuple[str, ...], all_: bool, datasets: tuple[str, ...], executor: str | None, as_json: bool
) -> None:
    """Test whether the algorithms or packages NAMES keep their bounds.

    Runs each mode on the datasets that are here and for which its algorithm.yaml states bounds. Compares the number of
    poses and the trajectory error with them. The exit code is 1 if a bound is not kept.
    """
    from slamhive.cli.waiting import run_to_end  # noqa: PLC0415 - lists make no runs
    from slamhive.services.bounds import bound_tests  # noqa: PLC0415

    if bool(names) == all_:
        raise InvalidInput("name the algorithms to test, or give --all", "slamhive algorithm list shows them")
    hive = cli.hive()
    algorithms = _chosen(hive, names)
    stated = bound_tests(algorithms, datasets)
    if not stated:
        asked = ", ".join(entry.name for entry in algorithms)
        where = f" on {', '.join(datasets)}" if datasets else ""
        raise InvalidInput(f"no bounds are stated for {asked}{where}", "add bounds to algorithm.yaml")
    here = {entry.name for entry in hive.catalogue.datasets()}
    missing = sorted({entry.bound.dataset for entry in stated} - here)
    if missing and not here.intersection(entry.bound.dataset for entry in stated):
        raise NotFound(f"no dataset of the bounds is here: {', '.join(missing)}", "make one: slamhive dataset room")
    for name in missing:
        left_out = ", ".join(entry.algorithm.name for entry in stated if entry.bound.dataset == name)
        tell(f"not tested on {name}, which is not here: {left_out}", style="yellow")
    tests = [entry for entry in stated if entry.bound.dataset in here]
    run_ids = [hive.runs.submit(entry.submission(executor))[0].id for entry in tests]
    run_to_end(hive, run_ids, evaluate=True)
    results = [entry.result(hive.runs.get(run_id)) for entry, run_id in zip(tests, run_ids, strict=True)]
    if as_json:
        print_json([result.content for result in results])
    else:
        _print(results)
    if any(result.problem is not None for result in results):
        raise click.exceptions.Exit(1)


def _chosen(hive: Hive, names: Sequence[str]) -> list[Algorithm]:
    """The algorithms called ``names`` or of packages called so; all without names."""
    known = hive.catalogue.algorithms()
    for name in names:
        if all(name not in {entry.name, entry.package.name} for entry in known):
            hive.catalogue.algorithm(name)  # explains what is wrong with the name
    return [entry for entry in known if not names or entry.name in names or entry.package.name in names]


def _print(results: Sequence[BoundResult]) -> None:
    rows = [
        (
            entry.algorithm,
            entry.bound.dataset,
            entry.run,
            entry.poses,
            entry.bound.poses,
            _number(entry.ate_rmse_m, 4),
            _number(entry.bound.ate_rmse_m, 4),
            _number(entry.relations_m, 4),
            _number(entry.bound.relations_m, 4),
            _number(entry.relations_deg, 2),
            _number(entry.bound.relations_deg, 2),
            _number(entry.latency_median_ms, 1),
            _number(entry.memory_max_mb, 0),
            "kept" if entry.problem is None else "NOT KEPT",
        )
        for entry in results
    ]
    print_table(COLUMNS, rows, right=COLUMNS[2:-1])
    for entry in results:
        if entry.problem is not None:
            tell(f"{entry.algorithm} on {entry.bound.dataset}: {entry.problem}", style="red")


def _number(value: float | None, digits: int) -> str | None:
    return None if value is None else f"{value:.{digits}f}"


# ``slamhive algorithm versions``, ``verify``, ``export``, ``remove-version`` and ``prune``.


_IDENTITY_DIGITS = 19
"""So much of a digest is shown: ``sha256:`` and twelve digits."""


@click.command("versions", short_help="List the versions of a package or algorithm")
@click.argument("name", shell_complete=completion.PACKAGE)
@json_option
@pass_cli
def versions(cli: CliContext, name: str, as_json: bool) -> None:
    """List the versions of the package or algorithm NAME with their number of runs."""
    reports = cli.hive().versions.reports(name)
    if as_json:
        from slamhive.documents.catalogue import Version  # noqa: PLC0415 - tables need no model

        print_json([Version.of(report).content for report in reports])
        return
    rows = [
        (
            report.record.label,
            report.record.version,
            report.record.identity[:_IDENTITY_DIGITS],
            f"{report.record.created_at:%Y-%m-%d %H:%M}",
            report.record.runs,
            ", ".join(report.runs_on) or ("removed" if report.record.removed_at else "gone"),
        )
        for report in reports
    ]
    print_table(("version", "upstream", "identity", "since", "runs", "runs on"), rows, right=("runs",))


@click.command("verify", short_help="Find changed or vanished images and folders")
@click.argument("name", required=False, shell_complete=completion.PACKAGE)
@json_option
@pass_cli
def verify(cli: CliContext, name: str | None, as_json: bool) -> None:
    """Find changed or vanished images and folders, of NAME or of all packages; exit code 1 if there are any."""
    findings = cli.hive().versions.verify(name)
    if as_json:
        print_json([asdict(finding) for finding in findings])
    elif findings:
        print_table(("version", "finding", "what"), [(entry.version, entry.kind, entry.words) for entry in findings])
    else:
        say("all versions are as they were")
    if findings:
        raise click.exceptions.Exit(1)


@click.command("export", short_help="Write image and package of a version to FILE")
@click.argument("version", metavar="NAME[@VERSION]", shell_complete=completion.PACKAGE)
@click.argument("file", type=click.Path(dir_okay=False, path_type=Path))
@click.option("--executor", help="The executor that has the image; default: the one in force.")
@pass_cli
def export(cli: CliContext, version: str, file: Path, executor: str | None) -> None:
    """Write image and package of a version to FILE, for `slamhive algorithm import` on another machine."""
    hive = cli.hive()
    chosen = hive.executors.get(hive.executors.choose(executor))
    record = hive.versions.export(version, file, chosen)
    say(f"{record.label}: {file}, {file.stat().st_size / 1e6:.0f} MB")


@click.command("remove-version")
@click.argument("version", metavar="NAME@VERSION", shell_complete=completion.PACKAGE)
@click.option("--with-runs", is_flag=True, help="Also if runs used it: they stay, but cannot be repeated with it.")
@pass_cli
def remove_version(cli: CliContext, version: str, with_runs: bool) -> None:
    """Remove image, environment and folder of a version. Its number and its runs stay."""
    record = cli.hive().versions.remove(version, with_runs=with_runs)
    say(f"{record.label} is removed; {plural(record.runs, 'run')} used it")


@click.command("prune", short_help="Remove the versions that nothing needs")
@click.argument("name", required=False, shell_complete=completion.PACKAGE)
@click.option("--dry-run", is_flag=True, help="Only list what would be removed.")
@pass_cli
def prune(cli: CliContext, name: str | None, dry_run: bool) -> None:
    """Remove the versions, of NAME or of all packages, that no run used. The newest of each package stays."""
    hive = cli.hive()
    unused = hive.versions.unused(name)
    for record in unused:
        if not dry_run:
            hive.versions.remove(record.label)
        say(f"{record.label}{'' if dry_run else ' is removed'}: {record.identity[:_IDENTITY_DIGITS]}")
    if not unused:
        say("no version is unused")


# ``slamhive algorithm weights``: the files with trained weights that a package needs.


@click.command("weights")
@click.argument("name", shell_complete=completion.PACKAGE)
@click.option("--file", "file", type=click.Path(path_type=Path), help="Add this file, which you have downloaded.")
@click.option("--as", "weights", metavar="WEIGHTS", help="The weights that --file holds.  [default: its file name]")
@click.option("--fetch", is_flag=True, help="Download what is missing from where its authors publish it.")
@json_option
@pass_cli
def weights_command(
    cli: CliContext, name: str, file: Path | None, weights: str | None, fetch: bool, as_json: bool
) -> None:
    """List, add or download the weights of the package NAME.

    Runs get them as read-only files. A file whose checksum differs is refused.
    """
    from slamhive.services.weights import WeightsStore  # noqa: PLC0415 - lists show no weights

    if fetch and file is not None:
        raise InvalidInput("--file and --fetch exclude each other", "give one of them")
    hive = cli.hive()
    package = hive.catalogue.package(name)
    store = WeightsStore(hive.settings)
    if file is not None:
        store.add(package, file, weights)
    elif fetch:
        store.fetch(package, lambda done, size: tell(f"{done / 1e6:,.0f} of {(size or 0) / 1e6:,.0f} MB", style="dim"))
    entries = store.stored(package)
    if as_json:
        rows = [
            {
                "name": entry.weights.name,
                "present": entry.present,
                "sha256": entry.sha256,
                "licence": entry.weights.licence,
                "page": entry.weights.page,
                "path": str(entry.path.relative_to(hive.settings.data)),
            }
            for entry in entries
        ]
        print_json(rows)
        return
    print_table(
        ("weights", "here", "SHA-256", "licence", "published at"),
        [
            (
                entry.weights.name,
                "yes" if entry.present else "no",
                "not known" if entry.sha256 is None else entry.sha256[:12],
                entry.weights.licence,
                entry.weights.page,
            )
            for entry in entries
        ],
    )


for _command in (import_, remove, test, versions, verify, export, remove_version, prune, weights_command):
    algorithm.add_command(_command)

COMMANDS = (algorithm,)
