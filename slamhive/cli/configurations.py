"""``slamhive configuration``: list, show, create, change, group, run, delete, export and import."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from slamhive.base import strict_yaml
from slamhive.base.errors import InvalidInput, SlamHiveError
from slamhive.base.files import write_aside
from slamhive.cli import completion
from slamhive.cli.context import CliContext, json_option, pass_cli
from slamhive.cli.output import print_json, print_match, print_table, tell
from slamhive.cli.running import all_of, content_options, run_options, submission_values
from slamhive.cli.runs import print_runs
from slamhive.cli.visible import say, write_out
from slamhive.documents.catalogue import MatchDocument
from slamhive.documents.submission import Submission
from slamhive.domain.parameters import Value
from slamhive.services.configurations import (
    ConfigurationChange,
    Label,
    Stored,
    configuration_document,
    parse_conditions,
)
from slamhive.store import ConfigurationFilter, ConfigurationRecord

RUNS_SHOWN = 10
SPARE = ("groups", "runs", "name", "variant")
label_options = all_of(
    click.option("--name", help="Name; empty removes it."),
    click.option("--note", help="Note; empty removes it."),
    click.option("--group", help="Add it to this group."),
)
change_options = all_of(
    click.option("--algorithm", help="Another algorithm; values are matched by key and general name."),
    click.option("--dataset", help="Another dataset."),
    content_options(changes=True),
    click.option("--no-steps", is_flag=True, help="Without pre-processing steps."),
    label_options,
)


@click.group()
def configuration() -> None:
    """Create and manage configurations. CONFIGURATION is a number or a name."""


@configuration.command("list")
@click.option("--algorithm", "algorithms", multiple=True, help="Only of these algorithms.")
@click.option("--dataset", "datasets", multiple=True, help="Only on these datasets.")
@click.option("--group", default="", help="Only those in this group.")
@click.option("--text", default="", help="Only those whose name or note contains this.")
@click.option("--used/--unused", default=None, help="Only those with, or without, runs.")
@click.option(
    "--where", "conditions", multiple=True, metavar="NAME=VALUE", help="By key or general name; also <= < > >=."
)
@click.option("--show", "shown", multiple=True, metavar="NAME", help="Add a column with this parameter.")
@click.option("--after", help="Continue after this number, the last of the previous page.")
@click.option("--limit", type=click.IntRange(1, 1000), default=50, show_default=True)
@json_option
@pass_cli
def list_(cli: CliContext, as_json: bool, **options: Any) -> None:
    """List configurations, newest first."""
    hive = cli.hive()
    group = options["group"] and hive.configurations.check_group(options["group"])
    wanted = ConfigurationFilter(
        algorithms=options["algorithms"],
        datasets=options["datasets"],
        group=group,
        text=options["text"],
        used=options["used"],
        conditions=parse_conditions(options["conditions"]),
    )
    page = hive.configurations.page(wanted, options["after"], options["limit"])
    if as_json:
        print_json([configuration_document(record).content for record in page.records])
        return
    if not page.records:
        tell("no configuration matches; `slamhive configuration create` makes one")
        return
    columns = ("id", "name", "algorithm", "dataset", *options["shown"], "variant", "groups", "runs")
    rows = [
        (
            record.id,
            record.name,
            record.configuration.algorithm,
            record.configuration.dataset,
            *(_value(record.value(name)) for name in options["shown"]),
            _steps(record),
            ", ".join(record.groups) or None,
            record.runs,
        )
        for record in page.records
    ]
    print_table(columns, rows, right=("id", "runs", *options["shown"]), spare=SPARE)
    more = "" if page.next_key is None else f"; continue with --after {page.next_key}"
    tell(f"{len(rows)} of {page.total} configurations{more}")


@configuration.command("show")
@click.argument("reference", metavar="CONFIGURATION")
@json_option
@pass_cli
def show(cli: CliContext, reference: str, as_json: bool) -> None:
    """Show one configuration with its latest runs."""
    hive = cli.hive()
    record = hive.configurations.find(reference)
    runs = hive.configurations.latest_runs(record.id, RUNS_SHOWN)
    if as_json:
        print_json({**configuration_document(record).content, "latest_runs": [run.id for run in runs]})
        return
    content = record.configuration
    say(f"{record.label}: {content.algorithm} on {content.dataset}")
    say(f"playback {content.playback.mode.value} x {content.playback.rate:g}; variant: {_steps(record) or 'none'}")
    for what, text in (("groups", ", ".join(record.groups)), ("experiments", ", ".join(record.experiments))):
        if text:
            say(f"{what}: {text}")
    if record.note:
        say(record.note)
    rows = [
        (key, _text(value), definition.type, definition.unit, definition.general)
        for key, value in content.parameters.items()
        for definition in [record.parameters[key]]
    ]
    print_table(("parameter", "value", "type", "unit", "general name"), rows, right=("value",))
    try:
        print_match(MatchDocument.of_match(hive.configurations.match(record.id)))
    except SlamHiveError as error:
        tell(f"note: {error}")
    print_runs(list(runs), as_json=False)
    if record.runs > len(runs):
        tell(f"the latest {len(runs)} of {record.runs} runs")


@configuration.command("create")
@click.argument("algorithm", shell_complete=completion.ALGORITHM)
@click.argument("dataset", shell_complete=completion.DATASET)
@content_options()
@label_options
@json_option
@pass_cli
def create(cli: CliContext, as_json: bool, **options: Any) -> None:
    """Create a configuration of ALGORITHM on DATASET without running it. Equal content gives the same configuration."""
    submission = Submission(**submission_values(options))
    _tell(cli.hive().configurations.create(submission, _label(options)), as_json)


@configuration.command("copy")
@click.argument("reference", metavar="CONFIGURATION")
@change_options
@json_option
@pass_cli
def copy(cli: CliContext, reference: str, as_json: bool, **options: Any) -> None:
    """Copy CONFIGURATION with changes."""
    service = cli.hive().configurations
    _tell(service.copy(service.find(reference).id, _changes(options), _label(options)), as_json)


@configuration.command("modify", short_help="Replace, rename or annotate a configuration")
@click.argument("reference", metavar="CONFIGURATION")
@change_options
@json_option
@pass_cli
def modify(cli: CliContext, reference: str, as_json: bool, **options: Any) -> None:
    """Replace CONFIGURATION by a changed one, or edit its name, note and group. It is kept if it has runs."""
    service = cli.hive().configurations
    _tell(service.modify(service.find(reference).id, _changes(options), _label(options)), as_json)


@configuration.command("delete", short_help="Delete configurations without runs")
@click.argument("references", metavar="CONFIGURATION...", nargs=-1, required=True)
@pass_cli
def delete(cli: CliContext, references: tuple[str, ...]) -> None:
    """Delete configurations without runs; if one has runs, none is deleted."""
    service = cli.hive().configurations
    records = [service.find(reference) for reference in references]
    service.delete([record.id for record in records])
    for record in records:
        say(f"{record.label} is deleted")


@configuration.command("export")
@click.argument("reference", metavar="CONFIGURATION")
@click.option("--output", type=click.Path(path_type=Path, dir_okay=False), help="A file instead of standard output.")
@pass_cli
def export(cli: CliContext, reference: str, output: Path | None) -> None:
    """Print CONFIGURATION as YAML, or write it to a file."""
    service = cli.hive().configurations
    text = service.export_yaml(service.find(reference).id)
    if output is None:
        write_out(text)
        return
    try:
        write_aside(output, text)
    except OSError as error:
        raise InvalidInput(f"{output} cannot be written: {error.strerror}") from None
    say(f"wrote {output}")


@configuration.command("import", short_help="Import a configuration from FILE")
@click.argument("file", type=click.Path(path_type=Path, allow_dash=True))
@label_options
@json_option
@pass_cli
def import_(cli: CliContext, file: Path, as_json: bool, **options: Any) -> None:
    """Import a configuration from FILE (- for standard input): our YAML, or a published config.yaml."""
    stored = cli.hive().configurations.import_yaml(_read(file), str(file), _label(options))
    _tell(stored, as_json)
    if stored.seed and not as_json:
        tell(f"the file also has a seed; to use it: slamhive configuration run --seed {stored.seed}")


@configuration.command("run")
@click.argument("reference", metavar="CONFIGURATION")
@run_options()
@json_option
@pass_cli
def run(cli: CliContext, reference: str, as_json: bool, **options: Any) -> None:
    """Queue runs of CONFIGURATION."""
    hive = cli.hive()
    record = hive.configurations.find(reference)
    print_runs(list(hive.runs.submit_configuration(record.id, **submission_values(options))), as_json)


@configuration.command("groups")
@json_option
@pass_cli
def groups(cli: CliContext, as_json: bool) -> None:
    """List all groups and their sizes."""
    found = cli.hive().configurations.groups()
    if as_json:
        print_json(found)
    elif found:
        print_table(("group", "configurations"), list(found.items()), right=("configurations",))
    else:
        tell("no groups; `slamhive configuration group NAME CONFIGURATION...` makes one")


@configuration.command("group")
@click.argument("name")
@click.argument("references", metavar="CONFIGURATION...", nargs=-1, required=True)
@click.option("--remove", is_flag=True, help="Remove them from the group; an empty group disappears.")
@pass_cli
def group(cli: CliContext, name: str, references: tuple[str, ...], remove: bool) -> None:
    """Add configurations to the group NAME, or remove them."""
    service = cli.hive().configurations
    service.group(name, [service.find(reference).id for reference in references], remove=remove)
    say(f"{name}: {service.groups().get(name.strip(), 0)} configurations")


def _changes(options: dict[str, Any]) -> ConfigurationChange:
    values = submission_values(options)
    if values["variant"] and options["no_steps"]:
        raise InvalidInput("--step and --no-steps are given", "give one of them")
    unchanged = not values["variant"] and not options["no_steps"]
    kept = {"variant": None if unchanged else values["variant"], "sensors": values["sensors"] or None}
    return ConfigurationChange(**{**values, **kept})


def _label(options: dict[str, Any]) -> Label:
    return Label(options["name"], options["note"], options["group"])


def _tell(stored: Stored, as_json: bool) -> None:
    for note in stored.notes:
        tell(note)
    if as_json:
        print_json(
            {**configuration_document(stored.record).content, "created": stored.created, "notes": list(stored.notes)}
        )
    else:
        say(stored.words)


def _read(file: Path) -> str:
    """The text of a file or of standard input, at most as long as a YAML file may be."""
    try:
        if str(file) == "-":
            return sys.stdin.read(strict_yaml.MAX_BYTES + 1)
        with file.open(encoding="utf-8") as stream:
            return stream.read(strict_yaml.MAX_BYTES + 1)
    except UnicodeDecodeError:
        raise InvalidInput(f"{file} is not UTF-8 text") from None
    except OSError as error:
        raise InvalidInput(f"{file} cannot be read: {error.strerror}") from None


def _steps(record: ConfigurationRecord) -> str | None:
    return "; ".join(str(step) for step in record.configuration.variant) or None


def _value(value: Value | None) -> str | None:
    return None if value is None else _text(value)


def _text(value: Value) -> str:
    return ", ".join(f"{number:g}" for number in value) if isinstance(value, tuple) else str(value)


COMMANDS = (configuration,)
