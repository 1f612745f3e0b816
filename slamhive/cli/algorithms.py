"""``slamhive algorithm``: list, show, build; ``test`` and versions have modules of their own."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import click

from slamhive.cli import offers
from slamhive.cli.context import CliContext, json_option, pass_cli
from slamhive.cli.groups import LazyGroup
from slamhive.cli.output import print_json, print_table, tell
from slamhive.cli.visible import say
from slamhive.domain.algorithm import Algorithm as Entry
from slamhive.domain.parameters import Parameter
from slamhive.errors import InvalidInput, SlamHiveError
from slamhive.schema.catalogue import Algorithm

_ELSEWHERE = {
    **dict.fromkeys(("import", "remove"), "algorithm_import"),
    "test": "algorithm_test",
    "weights": "algorithm_weights",
    **dict.fromkeys(("versions", "verify", "export", "remove-version", "prune"), "algorithm_versions"),
}


@click.group(cls=LazyGroup, modules=_ELSEWHERE)
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


@algorithm.command("show")
@click.argument("name", shell_complete=offers.ALGORITHM)
@json_option
@pass_cli
def show(cli: CliContext, name: str, as_json: bool) -> None:
    """Show one algorithm: what it needs, and its parameters with type, default, range and unit."""
    entry = cli.hive(indexed=False).catalogue.algorithm(name)
    if as_json:
        print_json(Algorithm.of(entry).content)
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


@algorithm.command("build")
@click.argument("names", nargs=-1, shell_complete=offers.PACKAGE)
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


def _json(entry: Entry, identities: Mapping[str, str | None]) -> dict[str, Any]:
    return {**Algorithm.of(entry).content, "identity": identities[entry.package.name]}


def _state(entry: Entry, identity: str | None) -> str:
    if entry.package.origin is not None:
        return "imported" if identity else "imported, but its image is gone"
    return "built" if identity else "not built"


def _default(parameter: Parameter) -> str:
    if parameter.source is not None:
        return f"from {parameter.source}"
    return "must be given" if parameter.must_be_given else _text(parameter.default)


def _text(value: Any) -> str:
    return ", ".join(f"{number:g}" for number in value) if isinstance(value, tuple) else str(value)


COMMANDS = (algorithm,)
