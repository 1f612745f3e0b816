"""``slamhive configuration``: list, show, make, change, group, run and remove configurations; YAML both ways."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from slamhive import strict_yaml
from slamhive.cli.context import CliContext, choice, json_option, pass_cli
from slamhive.cli.output import messages, print_json, print_table
from slamhive.cli.runs import parse_assignments, print_runs
from slamhive.cli.variants import parse_steps, step_option
from slamhive.domain.configuration import PlaybackMode
from slamhive.domain.parameters import Value
from slamhive.errors import InvalidInput
from slamhive.files import write_aside
from slamhive.services.configurations import Changes, Label, Stored, Submission, configuration_to_json, parse_conditions
from slamhive.store import ConfigurationFilter, ConfigurationRecord

RUNS_SHOWN = 10
SPARE = ("groups", "runs", "name", "variant")
Command = Callable[..., Any]


def _all_of(*options: Callable[[Command], Command]) -> Callable[[Command], Command]:
    """Several options of a command, in this order."""

    def add(command: Command) -> Command:
        for option in reversed(options):
            command = option(command)
        return command

    return add


set_option = click.option(
    "--set", "settings", multiple=True, metavar="KEY=VALUE", help="Set a parameter, by its key or general name."
)
label_options = _all_of(
    click.option("--name", help="A name of its own; empty removes it."),
    click.option("--note", help="A note; empty removes it."),
    click.option("--group", help="Put it into this group."),
)
change_options = _all_of(
    click.option("--algorithm", help="Another algorithm; values go over by key and general name."),
    click.option("--dataset", help="Another dataset."),
    set_option,
    step_option,
    click.option("--no-steps", is_flag=True, help="Without pre-processing steps."),
    click.option("--playback", type=choice(PlaybackMode), help="How the recording is fed."),
    click.option("--rate", type=float, help="Playback speed."),
    label_options,
)


@click.group()
def configuration() -> None:
    """Configurations: what exactly is run. CONFIGURATION is a number, or a name you gave."""


@configuration.command("list")
@click.option("--algorithm", "algorithms", multiple=True, help="Only of these algorithms.")
@click.option("--dataset", "datasets", multiple=True, help="Only on these datasets.")
@click.option("--group", default="", help="Only those in this group.")
@click.option("--text", default="", help="Only those whose name or note contains this.")
@click.option("--used/--unused", default=None, help="Only those with runs, or without.")
@click.option(
    "--where", "conditions", multiple=True, metavar="NAME=VALUE", help="By key or general name; also <= < > >=."
)
@click.option("--show", "shown", multiple=True, metavar="NAME", help="A column with the value of this parameter.")
@click.option("--after", help="Go on behind this number (the end of the page before).")
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
        print_json([configuration_to_json(record) for record in page.records])
        return
    if not page.records:
        messages.print("no configuration matches; `slamhive configuration create` makes one")
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
    more = "" if page.next_key is None else f"; --after {page.next_key} goes on"
    messages.print(f"{len(rows)} of {page.total} configurations{more}")


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
        print_json({**configuration_to_json(record), "latest_runs": [run.id for run in runs]})
        return
    content = record.configuration
    click.echo(f"{record.label}: {content.algorithm} on {content.dataset}")
    click.echo(
        f"playback {content.playback.mode.value} x {content.playback.rate:g}; variant: {_steps(record) or 'none'}"
    )
    for what, text in (("groups", ", ".join(record.groups)), ("experiments", ", ".join(record.experiments))):
        if text:
            click.echo(f"{what}: {text}")
    if record.note:
        click.echo(record.note)
    rows = [
        (key, _text(value), definition.type, definition.unit, definition.general)
        for key, value in content.parameters.items()
        for definition in [record.parameters[key]]
    ]
    print_table(("parameter", "value", "type", "unit", "general name"), rows, right=("value",))
    print_runs(list(runs), as_json=False)
    if record.runs > len(runs):
        messages.print(f"the latest {len(runs)} of {record.runs} runs")


@configuration.command("create")
@click.argument("algorithm")
@click.argument("dataset")
@set_option
@step_option
@click.option("--playback", type=choice(PlaybackMode), default="realtime", show_default=True)
@click.option("--rate", type=float, default=1.0, show_default=True, help="Playback speed.")
@label_options
@json_option
@pass_cli
def create(cli: CliContext, algorithm: str, dataset: str, as_json: bool, **options: Any) -> None:
    """Make a configuration of ALGORITHM on DATASET without running it; the same content is the same configuration."""
    submission = Submission(
        algorithm,
        dataset,
        parse_assignments(options["settings"]),
        playback_mode=options["playback"],
        playback_rate=options["rate"],
        variant=parse_steps(options["steps"]),
    )
    _tell(cli.hive().configurations.create(submission, _label(options)), as_json)


@configuration.command("copy")
@click.argument("reference", metavar="CONFIGURATION")
@change_options
@json_option
@pass_cli
def copy(cli: CliContext, reference: str, as_json: bool, **options: Any) -> None:
    """Make a copy of CONFIGURATION with changes."""
    service = cli.hive().configurations
    _tell(service.copy(service.find(reference).id, _changes(options), _label(options)), as_json)


@configuration.command("modify")
@click.argument("reference", metavar="CONFIGURATION")
@change_options
@json_option
@pass_cli
def modify(cli: CliContext, reference: str, as_json: bool, **options: Any) -> None:
    """Put a changed configuration in the place of CONFIGURATION, which stays if it has runs; or change what is said."""
    service = cli.hive().configurations
    _tell(service.modify(service.find(reference).id, _changes(options), _label(options)), as_json)


@configuration.command("delete")
@click.argument("references", metavar="CONFIGURATION...", nargs=-1, required=True)
@pass_cli
def delete(cli: CliContext, references: tuple[str, ...]) -> None:
    """Remove configurations without runs: all of them, or none if one has to stay."""
    service = cli.hive().configurations
    records = [service.find(reference) for reference in references]
    service.delete([record.id for record in records])
    for record in records:
        click.echo(f"{record.label} is deleted")


@configuration.command("export")
@click.argument("reference", metavar="CONFIGURATION")
@click.option("--output", type=click.Path(path_type=Path, dir_okay=False), help="A file; default: standard output.")
@pass_cli
def export(cli: CliContext, reference: str, output: Path | None) -> None:
    """Print CONFIGURATION as YAML, or write it to a file."""
    service = cli.hive().configurations
    text = service.export_yaml(service.find(reference).id)
    if output is None:
        click.echo(text, nl=False)
        return
    try:
        write_aside(output, text)
    except OSError as error:
        raise InvalidInput(f"{output} cannot be written: {error.strerror}") from None
    click.echo(f"wrote {output}")


@configuration.command("import")
@click.argument("file", type=click.Path(path_type=Path, allow_dash=True))
@label_options
@json_option
@pass_cli
def import_(cli: CliContext, file: Path, as_json: bool, **options: Any) -> None:
    """Read a configuration from FILE (- is standard input): our YAML, or the config.yaml of a published SLAM Hive."""
    stored = cli.hive().configurations.import_yaml(_read(file), str(file), _label(options))
    _tell(stored, as_json)
    if stored.seed and not as_json:
        messages.print(f"its seed {stored.seed} belongs to a run: slamhive configuration run --seed {stored.seed}")


@configuration.command("run")
@click.argument("reference", metavar="CONFIGURATION")
@click.option("--repeat", type=int, default=1, show_default=True, help="How many runs.")
@click.option("--seed", type=int, default=0, show_default=True, help="Seed of the first.")
@click.option("--executor", help="docker or process; default: the one in force.")
@click.option("--evaluate/--no-evaluate", default=True, show_default=True, help="Evaluate each run that succeeds.")
@json_option
@pass_cli
def run(cli: CliContext, reference: str, as_json: bool, **options: Any) -> None:
    """Queue runs of CONFIGURATION."""
    hive = cli.hive()
    record = hive.configurations.find(reference)
    print_runs(list(hive.runs.submit_configuration(record.id, **options)), as_json)


@configuration.command("groups")
@json_option
@pass_cli
def groups(cli: CliContext, as_json: bool) -> None:
    """List all groups, and how many configurations each has."""
    found = cli.hive().configurations.groups()
    if as_json:
        print_json(found)
    elif found:
        print_table(("group", "configurations"), list(found.items()), right=("configurations",))
    else:
        messages.print("no groups; `slamhive configuration group NAME CONFIGURATION...` makes one")


@configuration.command("group")
@click.argument("name")
@click.argument("references", metavar="CONFIGURATION...", nargs=-1, required=True)
@click.option("--remove", is_flag=True, help="Take them out; the group goes with its last.")
@pass_cli
def group(cli: CliContext, name: str, references: tuple[str, ...], remove: bool) -> None:
    """Put configurations into the group NAME, which is made if need be, or take them out."""
    service = cli.hive().configurations
    service.group(name, [service.find(reference).id for reference in references], remove=remove)
    click.echo(f"{name}: {service.groups().get(name.strip(), 0)} configurations")


def _changes(options: dict[str, Any]) -> Changes:
    steps = parse_steps(options["steps"])
    if steps and options["no_steps"]:
        raise InvalidInput("--step and --no-steps are given", "give one of them")
    return Changes(
        algorithm=options["algorithm"],
        dataset=options["dataset"],
        parameters=parse_assignments(options["settings"]),
        variant=steps if steps or options["no_steps"] else None,
        playback_mode=options["playback"],
        playback_rate=options["rate"],
    )


def _label(options: dict[str, Any]) -> Label:
    return Label(options["name"], options["note"], options["group"])


def _tell(stored: Stored, as_json: bool) -> None:
    for note in stored.notes:
        messages.print(note, markup=False, soft_wrap=True)
    if as_json:
        print_json({**configuration_to_json(stored.record), "created": stored.created, "notes": list(stored.notes)})
    else:
        click.echo(stored.words)


def _read(file: Path) -> str:
    """The text of a file, or of standard input; one too large is not read whole."""
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
