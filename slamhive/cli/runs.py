"""``slamhive runs``: list, show, cancel and retry runs. ``import`` has a module of its own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slamhive.base.errors import InvalidInput
from slamhive.cli import completion
from slamhive.cli.chosen_runs import ChosenRuns, SearchAction, runs_or_search
from slamhive.cli.context import CliContext, choice, json_option, pass_cli, run_number
from slamhive.cli.main import LazyGroup
from slamhive.cli.output import counting_bar, hint_in_words, print_json, print_table, tell
from slamhive.cli.searching import Listing, print_export, print_groups, search_of, split_columns, write_parquet
from slamhive.cli.sharing import in_words
from slamhive.cli.visible import say, write_raw
from slamhive.domain.accounts import Visibility
from slamhive.domain.algorithm import IMPORTED
from slamhive.domain.metrics import described
from slamhive.domain.names import plural
from slamhive.domain.run import FailureReason, NotesChange, RunNotes, RunState
from slamhive.domain.verdict import outcome_words
from slamhive.services.exports import disturbed_text
from slamhive.store import RunRecord, RunSort
from slamhive.store.records import protocol_uses

if TYPE_CHECKING:
    from slamhive.services.hive import Hive

SPARE = ("time s", "RAM MB", "CPU cores", "tracked", "poses", "dataset", "disturbed", "trust")
COLUMNS = (
    "id",
    "algorithm",
    "dataset",
    "outcome",
    "trust",
    "disturbed",
    "poses",
    "ATE m",
    "tracked",
    "CPU cores",
    "RAM MB",
    "time s",
)
LISTS = ("states", "reasons", "experiments", "algorithms", "datasets")
_ELSEWHERE = {
    "import": "imports",
    "share": "sharing",
}
NUMBERS = ("id", "poses", "ATE m", "tracked", "CPU cores", "RAM MB", "time s")


@click.group(cls=LazyGroup, modules=_ELSEWHERE, invoke_without_command=True)
@click.option("--where", default="", metavar="FILTER", help="Only these, e.g. 'ate.rmse < 0.1 and dataset ~ MH_0*'.")
@click.option("--saved", metavar="NAME", help="The filter, columns and order of a saved search.")
@click.option("--state", "states", type=choice(RunState), multiple=True, help="Only these states.")
@click.option("--reason", "reasons", type=choice(FailureReason), multiple=True, help="Only these failures.")
@click.option("--experiment", "experiments", multiple=True, help="Only those of these experiments.")
@click.option("--algorithm", "algorithms", multiple=True, help="Only these algorithms.")
@click.option("--dataset", "datasets", multiple=True, help="Only these datasets.")
@click.option("--columns", default="", help="Keys of columns, metrics and parameters, with commas.")
@click.option("--sort", help="Column, metric or parameter, e.g. ate.rmse.  [default: id]")
@click.option("--ascending", is_flag=True, help="Smallest first.")
@click.option("--group", type=click.Choice(["configuration"]), help="Mean and spread over the repeats.")
@click.option("--limit", type=click.IntRange(1), help="At most this many.  [default: 50; files: all]")
@click.option("--csv", "as_csv", is_flag=True, help="Print CSV.")
@click.option("--parquet", type=click.Path(dir_okay=False, path_type=Path), help="Write a Parquet file.")
@json_option
@pass_cli
@click.pass_context
def runs(context: click.Context, cli: CliContext, /, as_json: bool, **options: Any) -> None:
    """Search runs, or show one. docs/search.md explains filters."""
    if context.invoked_subcommand is not None:
        return
    if sum(map(bool, (options["as_csv"], options["parquet"], as_json))) > 1:
        raise InvalidInput("--csv, --json and --parquet exclude each other", "choose one of them")
    hive = cli.hive()
    by_default = "configuration" if options["group"] else "id"
    if options["saved"] is not None:
        saved = hive.searches.saved_named(options["saved"])
        if options["where"]:
            raise InvalidInput("--where and --saved exclude each other", "give one of them")
        by_default = saved.sort.key
        options |= {
            "where": saved.filter_text,
            "columns": options["columns"] or ",".join(saved.columns),
            "ascending": options["ascending"] if options["sort"] else not saved.sort.descending,
            "group": options["group"] or ("configuration" if saved.grouped else None),
        }
    list_runs(hive, {**options, "sort": options["sort"] or by_default}, as_json=as_json)


def list_runs(hive: Hive, options: dict[str, Any], *, as_json: bool) -> None:
    """Print or write the selected runs in the selected format."""
    search = search_of(hive, options["where"], {name.removesuffix("s"): options[name] for name in LISTS})
    sort = RunSort(options["sort"], not options["ascending"])
    listing = Listing(hive, search, sort, tuple(split_columns(options["columns"])), options["limit"])
    grouped = options["group"] is not None
    if options["parquet"] is not None or options["as_csv"] or (as_json and (grouped or listing.columns)):
        listing.tell_mixed(None, hive.searches.count(search))
    if options["parquet"] is not None:
        path = options["parquet"]
        rows = write_parquet(*listing.groups(), path) if grouped else write_parquet(*listing.runs(), path)
        say(f"{path}: {plural(rows, 'row' if grouped else 'run')}, {listing.in_words(grouped=grouped)}")
    elif options["as_csv"] or (as_json and (grouped or listing.columns)):
        kind = "csv" if options["as_csv"] else "json"
        if grouped:
            print_export(*listing.groups(), kind=kind)
        else:
            print_export(*listing.runs(), kind=kind)
    elif grouped:
        print_groups(listing)
    else:
        page = hive.stored_runs.page(listing.search, listing.sort, limit=listing.size)
        if page.records and listing.columns:
            content, pages = replace(listing, limit=listing.size).runs()
            print_table(content.columns, list(content.rows(pages)))
        elif page.records or as_json:
            print_runs(list(page.records), as_json)
        listing.tell_mixed(protocol_uses(page.records), page.count)
        if not as_json:
            tell(listing.summary(len(page.records), page.count))


@runs.command("show", short_help="Show what matters of one run")
@click.argument("run_id", type=run_number, shell_complete=completion.RUN)
@click.option("--all", "everything", is_flag=True, help="Also all parameters, metrics and changes of state.")
@json_option
@pass_cli
def show(cli: CliContext, run_id: int, everything: bool, as_json: bool) -> None:
    """Show what matters of one run: outcome, configuration, error, resources, trust, files, and what to do next."""
    from slamhive.services.evaluations import evaluation_notes  # noqa: PLC0415 - the list of runs needs none

    hive = cli.hive()
    entry, recorded = hive.runs.get(run_id), hive.runs.record(run_id)
    content = {
        **hive.runs.in_full(run_id).content,
        "folder": str(hive.runs.folder(run_id).root),
        "provenance": {key: recorded.get(key) for key in ("software", "algorithm", "dataset", "host", "match")},
    }
    if as_json:
        print_json(content)
        return
    lines = [*_summary(entry, content["folder"]), *_written(entry)]
    if entry.protocol is not None:
        hints = evaluation_notes(hive.runs.folder(run_id), entry.protocol.fingerprint).hints
        lines += [f"hint: {hint_in_words(hint)}" for hint in hints]
    lines += [
        f"evaluation {evaluation['id']} {evaluation['state']}: {evaluation['reason']}"
        for evaluation in content["evaluations"]
        if evaluation["reason"]
    ]
    say("\n".join(lines))
    if not everything:
        return
    from slamhive.cli.output import bound_rows  # noqa: PLC0415 - the list of runs needs none
    from slamhive.documents.catalogue import MatchDocument  # noqa: PLC0415

    match = recorded.get("match")
    metrics = [
        (key, f"{part['value']:.6g}", part["unit"], described(key).sample(entry.metrics or {}))
        for key, part in (content["metrics"] or {}).items()
    ]
    tables: tuple[tuple[tuple[str, ...], list[tuple[Any, ...]]], ...] = (
        (("option", "value"), list(entry.stated.items())),
        (("parameter", "value"), list(content["parameters"].items())),
        (("parameter", "value", "source"), list(bound_rows(MatchDocument.read(match) if match else None))),
        (("metric", "value", "unit", "over"), metrics),
        (("at", "from", "to", "why"), [(e["at"], e["from"], e["to"], e["why"]) for e in content["events"]]),
    )
    for columns, rows in tables:
        if rows:
            say()
            print_table(columns, rows, right=("value",) if rows is metrics else ())


@runs.command("log")
@click.argument("run_id", type=run_number, shell_complete=completion.RUN)
@click.option(
    "--bytes",
    "max_bytes",
    type=click.IntRange(1),
    default=200_000,
    show_default=True,
    help="At most this much of the end.",
)
@click.option("--raw", is_flag=True, help="Print also what steers the terminal, such as colours.")
@pass_cli
def log(cli: CliContext, run_id: int, max_bytes: int, raw: bool) -> None:
    r"""Print the output of a run. What would steer the terminal is shown, such as \x1b."""
    text = cli.hive().runs.log(run_id, max_bytes)
    if raw:
        write_raw(text)
    else:
        say(text, nl=False)


@runs.command("cancel", short_help="Cancel queued and active runs")
@click.argument("run_ids", type=run_number, nargs=-1, required=True, shell_complete=completion.RUN)
@json_option
@pass_cli
def cancel(cli: CliContext, run_ids: tuple[int, ...], as_json: bool) -> None:
    """Cancel runs: queued ones at once, active ones when their worker has stopped them."""
    entries: list[RunRecord] = []
    for run_id in run_ids:
        entry = cli.hive().runs.cancel(run_id)
        entries.append(entry)
        if not as_json:
            say(f"run {entry.id}: {entry.state if entry.state.ended else 'is being cancelled'}")
    if as_json:
        print_runs(entries, as_json)


@runs.command("retry")
@runs_or_search
@json_option
@pass_cli
def retry(cli: CliContext, /, as_json: bool, **options: Any) -> None:
    """Queue new runs with the configurations of finished ones."""
    hive, chosen = cli.hive(), ChosenRuns(**options)
    if chosen.where is not None:
        action = SearchAction("retry", "queue {runs} again?", "{runs} queued, which repeat those of the search")
        chosen.act(hive, action, hive.search_actions.retry, as_json=as_json)
        return
    print_runs([hive.runs.retry(run_id) for run_id in chosen.run_ids], as_json)


_NAMED_PARAMETERS = 4


def _summary(entry: RunRecord, folder: str) -> list[str]:
    """The lines on a run that matter to everybody. What is not known yet has none."""
    number = entry.version and entry.version.number
    named = [f", {key}={value}" for key, value in list(entry.parameters.items())[:_NAMED_PARAMETERS]]
    more = len(entry.parameters) - len(named)
    parameters = "".join(named) + (f" and {more} more" if more else "")
    steps = ", ".join(step.brief for step in entry.variant) or "unchanged"
    played = "" if entry.executor == IMPORTED else f", played in {entry.playback.mode} mode"
    doubt = f", {entry.trust.doubt}" if entry.trust is not None and entry.trust.doubt else ""
    metrics = entry.metrics or {}
    used = (
        _number(metrics.get("cpu.mean"), "{:.2f} CPU cores on average"),
        _number(metrics.get("ram.max"), "{:.0f} MB of RAM at most", 1e-6),
    )
    lines = [
        f"run {entry.id}: {entry.algorithm} on {entry.dataset}, {outcome_words(entry)}{doubt}",
        f"{entry.reason or 'note'}: {entry.detail}" if entry.detail else "",
        f"verdict: {entry.verdict.kind.label}. {entry.verdict.words}" if entry.verdict is not None else "",
        f"configuration: {entry.configuration_id}, {entry.package}{f'@{number}' if number else ''}{parameters}",
        f"dataset: {entry.dataset}, {steps}{played}",
        _error(entry),
        f"used: {', '.join(filter(None, used))}" if any(used) else "",
        _duration(entry),
        _trust(entry),
        f"folder: {folder}",
        f"next: {_next(entry)}",
    ]
    return [line for line in lines if line]


def _error(entry: RunRecord) -> str:
    """The error with the protocol that it depends on; empty without an evaluation."""
    if entry.protocol is None:
        return ""
    found = _number((entry.metrics or {}).get("ate.rmse"), "ATE RMSE {:.3g} m") or "no ATE"
    return f"error: {found}, by {entry.protocol.label} (protocol {entry.protocol.fingerprint})"


def _duration(entry: RunRecord) -> str:
    """The time that the algorithm took, and when it ended; empty before the end."""
    took = _number((entry.metrics or {}).get("duration"), "{:.1f} s")
    ended = f"ended at {entry.ended_at:%Y-%m-%d %H:%M} UTC" if entry.ended_at is not None else None
    return f"duration: {', '.join(filter(None, (took, ended)))}" if took or ended else ""


def _trust(entry: RunRecord) -> str:
    """The trust in the measurements with reasons and remedies; empty before the end."""
    if entry.trust is None:
        return ""
    said = [part for part in (entry.trust.words, *entry.trust.remedies) if part]
    return f"trust: {entry.trust.mark or 'unknown'}{'. ' if said else ''}{'; '.join(said)}"


def _next(entry: RunRecord) -> str:
    """The command that people need after looking at such a run."""
    log = f"slamhive runs log {entry.id}"
    if entry.state is RunState.SUCCEEDED and entry.protocol is None:
        return f"slamhive evaluate {entry.id} computes its error"
    if entry.state is RunState.SUCCEEDED:
        lost = entry.verdict is not None and entry.verdict.failed
        first = f"{log} prints what it said" if lost else f"slamhive compare {entry.id} RUN puts it beside another"
        return f"{first}; slamhive runs show {entry.id} --all has all metrics"
    cancel, again = f"slamhive runs cancel {entry.id}", f"slamhive runs retry {entry.id} runs it again"
    by_state = {
        RunState.QUEUED: f"slamhive worker executes it, unless one runs already; {cancel} takes it back",
        RunState.CANCELLED: again,
        RunState.FAILED: f"{log} prints what it said; {again}",
    }
    return by_state.get(entry.state, f"{log} prints what it says; {cancel} stops it")


def _written(entry: RunRecord) -> list[str]:
    """Lines about owner and readers, and the tags and the note that people wrote."""
    restricted = entry.owner is not None or entry.seen_by is not Visibility.TEAM
    lines = [
        in_words(entry.owner, entry.seen_by) if restricted else "",
        f"tags: {', '.join(entry.tags)}" if entry.tags else "",
        f"note: {entry.note}" if entry.note else "",
    ]
    return [line for line in lines if line]


def run_row(entry: RunRecord) -> tuple[Any, ...]:
    """One row of the table of runs."""
    metrics = entry.metrics or {}
    return (
        entry.id,
        entry.algorithm,
        entry.dataset,
        outcome_words(entry),
        None if entry.trust is None else entry.trust.mark or None,
        disturbed_text(entry.disturbance),
        entry.poses,
        _number(metrics.get("ate.rmse"), "{:.4f}"),
        _number(metrics.get("tracked_fraction"), "{:.3f}"),
        _number(metrics.get("cpu.mean"), "{:.2f}"),
        _number(metrics.get("ram.max"), "{:.0f}", 1e-6),
        _number(metrics.get("duration"), "{:.1f}"),
    )


def _number(value: float | None, pattern: str, factor: float = 1.0) -> str | None:
    return None if value is None else pattern.format(value * factor)


def print_runs(entries: list[RunRecord], as_json: bool) -> None:
    """Runs as a table on stdout, or as a JSON list."""
    if as_json:
        from slamhive.documents.run import RunDocument  # noqa: PLC0415 - the models of documents take long to make

        print_json([RunDocument.of(entry).content for entry in entries])
    elif entries:
        print_table(COLUMNS, [run_row(entry) for entry in entries], right=NUMBERS, spare=SPARE)
        for entry in entries:
            if entry.detail and entry.state is RunState.FAILED:
                tell(f"run {entry.id}: {entry.detail}")
            if entry.verdict is not None and entry.verdict.failed and entry.state is RunState.SUCCEEDED:
                tell(f"run {entry.id}: {entry.verdict.words}")
            if entry.trust is not None and entry.trust.reasons:
                tell(f"run {entry.id} is {entry.trust.doubt}: {entry.trust.words}")
    else:
        tell("no runs; `slamhive run ALGORITHM DATASET` starts one")


# ``slamhive runs note`` and ``slamhive runs tag``: what people write about runs.


@click.command("note")
@click.argument("run_id", type=run_number, shell_complete=completion.RUN)
@click.argument("text")
@json_option
@pass_cli
def note(cli: CliContext, run_id: int, text: str, as_json: bool) -> None:
    """Write the note of a run; an empty text removes it."""
    _show(cli.hive().notes.change([run_id], NotesChange(note=text)), as_json=as_json)


@click.command("tag")
@runs_or_search
@click.option("--add", multiple=True, metavar="TAG", help="Give the runs this tag.")
@click.option("--remove", multiple=True, metavar="TAG", help="Take this tag away from them.")
@json_option
@pass_cli
def tag(cli: CliContext, /, add: tuple[str, ...], remove: tuple[str, ...], as_json: bool, **chosen: Any) -> None:
    """Add tags to runs, or remove them. Filters find them: tag = paper."""
    hive, runs = cli.hive(), ChosenRuns(**chosen)
    if not add and not remove:
        raise InvalidInput("no tag is named", "use --add TAG or --remove TAG")
    change = NotesChange(add=add, remove=remove)
    if runs.where is None:
        _show(hive.notes.change(runs.run_ids, change), as_json=as_json)
        return
    action = SearchAction("tag", "change the tags of {runs}?", "the tags of {runs} are stored")
    runs.act(hive, action, lambda ids, progress: hive.search_actions.tag(ids, change, progress), as_json=as_json)


def _show(changed: dict[int, RunNotes], *, as_json: bool) -> None:
    if as_json:
        print_json([{"id": run_id, **notes.content} for run_id, notes in changed.items()])
        return
    for run_id, notes in changed.items():
        said = [f"tags {', '.join(notes.tags)}" if notes.tags else "no tags"] + ([notes.note] if notes.note else [])
        say(f"run {run_id}: {'; '.join(said)}")


# ``slamhive runs delete``, ``restore`` and ``trash``.


@click.command("delete")
@runs_or_search
@json_option
@pass_cli
def delete(cli: CliContext, /, as_json: bool, **chosen: Any) -> None:
    """Move runs that have ended to the trash, with their files.

    With --where, runs that have not ended or are being evaluated are left out.
    """
    hive, runs = cli.hive(), ChosenRuns(**chosen)
    if runs.where is not None:
        action = SearchAction("delete", "move {runs} to the trash?", "{runs} moved to the trash")
        acted = runs.act(hive, action, hive.search_actions.delete, as_json=as_json)
        if acted.at is not None and acted.done and not as_json:
            say(f"slamhive runs restore --deleted-at {acted.at.isoformat()} takes them out again")
        return
    deleted = hive.trash.delete(runs.run_ids)
    if as_json:
        print_json({"done": len(deleted), "left_out": 0, "reasons": []})
        return
    numbers = " ".join(str(run.id) for run in deleted)
    say(f"{plural(len(deleted), 'run')} moved to the trash; slamhive runs restore {numbers} takes them out again")


@click.command("restore")
@click.argument("run_ids", type=run_number, nargs=-1, shell_complete=completion.RUN)
@click.option("--deleted-at", metavar="TIME", help="All runs that one command deleted at this time, as it said.")
@pass_cli
def restore(cli: CliContext, run_ids: tuple[int, ...], deleted_at: str | None) -> None:
    """Take runs out of the trash, under their old numbers."""
    if bool(run_ids) == (deleted_at is not None):
        raise InvalidInput("name runs by number, or give --deleted-at: one of the two", "see slamhive runs trash")
    hive = cli.hive()
    wanted = list(run_ids) if deleted_at is None else hive.trash.deleted_together(deleted_at)
    with counting_bar("restore", len(wanted)) as bar:
        restored = hive.trash.restore(wanted, lambda done: bar(done, ""))
    say(f"{plural(len(restored), 'run')} restored")


@click.command("trash")
@click.option("--empty", is_flag=True, help="Remove the files of all deleted runs for good.")
@json_option
@pass_cli
def trash(cli: CliContext, empty: bool, as_json: bool) -> None:
    """List the deleted runs, or remove them for good."""
    hive = cli.hive()
    if empty:
        say(f"{plural(hive.trash.empty(), 'run')} removed for good")
        return
    found = hive.trash.listed()
    rows = [(run.deleted.run_id, run.algorithm, run.dataset, run.deleted.at.isoformat()) for run in found]
    columns = ("id", "algorithm", "dataset", "deleted_at")
    if as_json:
        from slamhive.documents.api import DeletedRunDocument  # noqa: PLC0415 - the table needs no model

        print_json([DeletedRunDocument.of(run).content for run in found])
    elif rows:
        print_table(columns, rows, right=("id",))
    else:
        tell("the trash is empty")


for _command in (note, tag, delete, restore, trash):
    runs.add_command(_command)

COMMANDS = (runs,)
