"""``slamhive gate`` and ``slamhive claims``: runs against a baseline, and against the numbers of papers."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slamhive.base.errors import InvalidInput
from slamhive.base.files import write_aside
from slamhive.cli import completion
from slamhive.cli.context import CliContext, json_option, pass_cli
from slamhive.cli.main import LazyGroup
from slamhive.cli.output import counting_bar, print_json, print_table, progress_bar, tell
from slamhive.cli.running import content_options, submission_values
from slamhive.cli.visible import Answering, say
from slamhive.domain.claim import ClaimState
from slamhive.domain.gate import DEFAULT_MARGINS, Answer, BisectOutcome
from slamhive.domain.names import mean_and_std, plural
from slamhive.domain.question import read_budget

if TYPE_CHECKING:
    from slamhive.documents.claims import ClaimsAnswer
    from slamhive.documents.gate import Baseline, BisectAnswer, GateAnswer

EXIT_CODES = {Answer.PASS: 0, Answer.WORSE: 1, Answer.UNDECIDED: 3}
STYLES = {Answer.PASS: "green", Answer.WORSE: "red", Answer.UNDECIDED: "yellow"}
_DEFAULTS = ", ".join(f"{key}={margin.words().replace(' ', '')}" for key, margin in DEFAULT_MARGINS.items())


class AnsweringGroup(Answering, LazyGroup):
    """A group of commands whose exit code is their answer."""


@click.group(cls=AnsweringGroup)
def gate() -> None:
    """Find out if runs became worse, since which commit, and which seconds show it. docs/gate.md is a tutorial.

    `check` is for continuous integration, `bisect` and `shrink` are for what comes after. The exit code of a mistake
    is 2.
    """


@gate.command()
@click.argument("name")
@click.option("--where", required=True, metavar="FILTER", help="The runs, e.g. 'algorithm = kiss-icp and version = 3'.")
@click.option("--protocol", metavar="FINGERPRINT", help="Take the errors under this one.  [default: what lists show]")
@click.option("--replace", is_flag=True, help="Replace a baseline of the same name.")
@json_option
@pass_cli
def baseline(cli: CliContext, name: str, where: str, protocol: str | None, replace: bool, as_json: bool) -> None:
    """Freeze the values of runs as the baseline NAME.

    Runs that have not ended, were cancelled or were not evaluated are left out; failed runs are part of it.
    """
    frozen = cli.hive().gates.baselines.freeze(name, where, protocol, replace=replace)
    if as_json:
        print_json(frozen.baseline.content)
    else:
        say(f"baseline {name}: {_counts(frozen.baseline)}")
    if frozen.left_out:
        tell(f"{plural(frozen.left_out, 'run')} left out: not ended, cancelled, or not evaluated")


@gate.command("list")
@json_option
@pass_cli
def list_(cli: CliContext, as_json: bool) -> None:
    """List baselines."""
    found = cli.hive().gates.baselines.briefs()
    if as_json:
        print_json([entry.content for entry in found])
    elif found:
        rows = [
            (
                entry.name,
                ", ".join(entry.algorithms),
                ", ".join(entry.datasets),
                entry.runs,
                entry.failed,
                f"{entry.made_at:%Y-%m-%d %H:%M}",
            )
            for entry in found
        ]
        heads = ("name", "algorithms", "datasets", "runs", "failed", "made at")
        print_table(heads, rows, right=("runs", "failed"), cut=("datasets", "algorithms"))
    else:
        tell("no baselines; `slamhive gate baseline NAME --where FILTER` makes one")


@gate.command()
@click.argument("baseline_name", metavar="BASELINE", shell_complete=completion.BASELINE)
@json_option
@pass_cli
def show(cli: CliContext, baseline_name: str, as_json: bool) -> None:
    """Show BASELINE, which is a name or a file that ends with .json."""
    found = cli.hive().gates.baselines.get(baseline_name)
    if as_json:
        print_json(found.content)
        return
    say(f"baseline {found.name}: {_counts(found)}")
    say(f"made {found.made_at:%Y-%m-%d %H:%M} by slamhive {found.software} of runs where {found.where}")
    rows = [
        (
            name,
            len(entry.runs),
            sum(run.failed is not None for run in entry.runs),
            ", ".join(sorted({run.version for run in entry.runs if run.version is not None})) or None,
            ", ".join(sorted({run.cpu_model for run in entry.runs if run.cpu_model is not None})) or None,
            entry.protocol.label,
        )
        for name, entry in zip(found.names, found.configurations, strict=True)
    ]
    heads = ("configuration", "runs", "failed", "version", "processor", "protocol")
    print_table(heads, rows, right=("runs", "failed"))


@gate.command(short_help="Write the baseline NAME to FILE")
@click.argument("name", shell_complete=completion.BASELINE)
@click.argument("file", type=click.Path(dir_okay=False, path_type=Path))
@pass_cli
def export(cli: CliContext, name: str, file: Path) -> None:
    """Write the baseline NAME to FILE, to keep it in a repository; `gate check FILE` reads it."""
    cli.hive().gates.baselines.export(name, file)
    say(f"baseline {name} written to {file}")


@gate.command()
@click.argument("name", shell_complete=completion.BASELINE)
@pass_cli
def remove(cli: CliContext, name: str) -> None:
    """Delete the baseline NAME; its runs stay."""
    cli.hive().gates.baselines.remove(name)
    say(f"baseline {name} removed")


@gate.command(short_help="Check if runs became worse than BASELINE")
@click.argument("baseline_name", metavar="BASELINE", shell_complete=completion.BASELINE)
@click.option("--where", metavar="FILTER", help="Check runs that exist; those of the baseline are left out.")
@click.option(
    "--run",
    "algorithms",
    multiple=True,
    metavar="ALGORITHM",
    help="Run the baseline's configurations of this algorithm (NAME or NAME@VERSION) and check that; may be repeated.",
)
@click.option("--repeats", type=click.IntRange(1, 1000), default=5, show_default=True, help="First runs of each.")
@click.option("--budget", metavar="BUDGET", help="Repeat until decided, in all at most e.g. '20 runs' or '30 min'.")
@click.option("--executor", help="Where runs are executed; by default the executor in force.")
@click.option(
    "--margin",
    "margins",
    multiple=True,
    metavar="METRIC=MARGIN",
    help=f"A share (5%), a number in the metric's unit, or off; may be repeated.  [default: {_DEFAULTS}]",
)
@click.option("--ignore", "ignored", multiple=True, metavar="PARAMETER", help="A parameter that may differ.")
@click.option("--partial", is_flag=True, help="Configurations of the baseline without runs do not prevent a pass.")
@click.option("--evaluate", is_flag=True, help="First evaluate runs that lack the protocol of the baseline.")
@click.option("--markdown", type=click.Path(dir_okay=False, path_type=Path), help="Write a summary for a comment.")
@click.option("--junit", type=click.Path(dir_okay=False, path_type=Path), help="Write JUnit XML.")
@json_option
@pass_cli
def check(cli: CliContext, /, baseline_name: str, as_json: bool, **options: Any) -> None:
    """Check whether runs became worse than BASELINE, a name or a file that ends with .json.

    The exit code is 0 if no metric became worse by more than its margin, and 1 if one did and chance does not explain
    it. It is 3 if the runs are too few to say, and 2 for a mistake.
    """
    hive = cli.hive()
    if (options["where"] is None) != bool(options["algorithms"]):
        raise InvalidInput("name the runs to check by --where, or start them by --run: one of the two")
    if options["budget"] is not None and not options["algorithms"]:
        raise InvalidInput("--budget is for runs that the check starts", "give --run, or leave it out")
    for path in (options["markdown"], options["junit"]):
        if path is not None and not path.parent.is_dir():
            raise InvalidInput(f"folder {path.parent} does not exist", "make it first")
    prepared = hive.gates.prepare(baseline_name, options["margins"], options["ignored"], partial=options["partial"])
    if options["algorithms"]:
        from slamhive.cli.waiting import run_to_end  # noqa: PLC0415 - loads the worker
        from slamhive.services.gates import Repeats, repeat_until_decided  # noqa: PLC0415

        budget = None if options["budget"] is None else read_budget(options["budget"])
        repeats = Repeats(options["repeats"], budget, options["executor"])
        work = partial(run_to_end, hive, evaluate=True)
        answer = repeat_until_decided(hive.gates, prepared, options["algorithms"], repeats, work)
    else:
        run_ids = hive.searches.find(options["where"])
        if options["evaluate"]:
            from slamhive.cli.waiting import evaluate_to_end  # noqa: PLC0415 - few checks evaluate
            from slamhive.domain.protocol import exactly  # noqa: PLC0415

            for protocol, lacking in hive.gates.lacking(prepared, run_ids).items():
                queued = hive.evaluations.queue(lacking, exactly(protocol, protocol.fingerprint))
                evaluate_to_end(hive.evaluations, queued)
        answer = hive.gates.answer(prepared, run_ids)
    print_json(answer.content) if as_json else _print(answer)
    _write(answer, options["markdown"], options["junit"])
    raise click.exceptions.Exit(EXIT_CODES[answer.answer])


@gate.command(short_help="Find the commit that made runs worse")
@click.option("--repo", type=click.Path(path_type=Path), required=True, help="The folder of a Git repository.")
@click.option("--good", required=True, metavar="REV", help="A commit, tag or branch that is good.")
@click.option("--bad", default="HEAD", show_default=True, metavar="REV", help="A later one that is worse.")
@click.option("--dataset", "datasets", multiple=True, shell_complete=completion.DATASET, help="May be repeated.")
@click.option("--baseline", metavar="BASELINE", help="Run its configurations, in place of --dataset.")
@click.option("--folder", metavar="FOLDER", help="Where algorithm.yaml is in the repository.  [default: to be found]")
@click.option("--package", metavar="NAME", help="A package here that takes the repository as its source.")
@click.option("--into", default="source", show_default=True, metavar="FOLDER", help="Where in that package it goes.")
@click.option("--algorithm", metavar="NAME", help="Which of the package's algorithms, if it has several.")
@click.option("--metric", default="ate.rmse", show_default=True, help="What became worse; or failures.")
@click.option("--difference", default="5%", show_default=True, help="How much worse than the good commit is allowed.")
@click.option("--half-way", is_flag=True, help="Tell commits apart half way between both ends: takes fewer runs.")
@click.option(
    "--error", type=click.FloatRange(0.001, 0.5), default=0.05, show_default=True, help="Chance of a false answer."
)
@click.option(
    "--most", type=click.IntRange(2, 1000), default=50, show_default=True, help="Runs after which a commit is skipped."
)
@click.option("--budget", metavar="BUDGET", help="Of all runs, e.g. '200 runs' or '2 h'.  [default: none]")
@click.option("--restart", is_flag=True, help="Forget what an earlier search with the same options found out.")
@click.option("--executor", help="Where commits are built and run; by default the executor in force.")
@content_options()
@json_option
@pass_cli
def bisect(cli: CliContext, /, as_json: bool, **options: Any) -> None:
    """Find the commit of a Git repository that made runs worse.

    Commits between --good and --bad are built and run until it is certain whether each is worse than the good one.
    Those that do not build or run are skipped. The working tree is not touched. A search that was interrupted goes on
    with the same command.

    The exit code is 0 if the commit was found, 3 if runs or commits that build are too few, and 2 for a mistake.
    """
    from slamhive.cli.waiting import run_to_end  # noqa: PLC0415 - loads the worker
    from slamhive.documents.submission import Submission  # noqa: PLC0415 - as above
    from slamhive.experiments.file import read_difference  # noqa: PLC0415 - as above
    from slamhive.services.gates import BisectRequest, searched_metric  # noqa: PLC0415 - loads scipy

    hive = cli.hive()
    if bool(options["datasets"]) == (options["baseline"] is not None):
        raise InvalidInput("say what to run: --dataset, or --baseline", "one of the two")
    metric = searched_metric(options["metric"])
    own = ("datasets", "baseline", "folder", "package", "into", "algorithm", "half_way", "error", "most", "restart")
    # The search chooses algorithm and dataset of each run.
    values = {name: value for name, value in submission_values(options).items() if name not in ("algorithm", "dataset")}
    request = BisectRequest(
        repository=options["repo"],
        submission=Submission("", "", **values),
        metric=metric,
        difference=read_difference(options["difference"], metric),
        budget=None if options["budget"] is None else read_budget(options["budget"]),
        **{name: options[name] for name in (*own, "good", "bad")},
    )
    answer = hive.bisections.find(request, partial(run_to_end, hive, evaluate=True), partial(tell, style="dim"))
    print_json(answer.content) if as_json else _print_bisect(answer)
    raise click.exceptions.Exit(0 if answer.answer is BisectOutcome.FOUND else EXIT_CODES[Answer.UNDECIDED])


@gate.command(short_help="Find the shortest clip that shows what is wrong with RUN")
@click.argument("run_id", metavar="RUN", type=click.IntRange(1))
@click.option("--against", metavar="RUN|ALGORITHM@VERSION", help="What is good, if RUN did not fail.")
@click.option("--worse-than", type=float, metavar="NUMBER", help="The value that good runs do not exceed.")
@click.option("--metric", default="ate.rmse", show_default=True, help="What is compared, if RUN did not fail.")
@click.option("--difference", default="5%", show_default=True, help="How much worse than --against is allowed.")
@click.option(
    "--share", type=click.FloatRange(0.01, 0.99), default=0.5, show_default=True, help="Of runs that show a failure."
)
@click.option("--to", "target", type=click.Path(path_type=Path), help="The new folder.  [default: DATASET-run-RUN]")
@click.option("--step", "step_s", type=click.FloatRange(0.05), metavar="SECONDS", help="Tries ends at multiples of it.")
@click.option(
    "--error", type=click.FloatRange(0.001, 0.5), default=0.05, show_default=True, help="Chance of a false answer."
)
@click.option(
    "--most", type=click.IntRange(2, 1000), default=50, show_default=True, help="Runs after which a clip is given up."
)
@click.option("--budget", metavar="BUDGET", help="Of all runs, e.g. '200 runs' or '2 h'.  [default: none]")
@json_option
@pass_cli
def shrink(cli: CliContext, /, run_id: int, as_json: bool, **options: Any) -> None:
    """Find the shortest part of the recording of RUN that still shows what is wrong, and write it to a folder.

    Parts of the recording are run until it is certain whether they show it: the same failure, an error that is worse
    than that of --against, or one above --worse-than. The folder is a dataset of these seconds, with the sensors that
    the algorithm needs. A search that was interrupted goes on with the same command.

    The exit code is 0 if the clip was written, 3 if the budget was too small, and 2 for a mistake.
    """
    from slamhive.cli.waiting import run_to_end  # noqa: PLC0415 - loads the worker
    from slamhive.experiments.file import read_difference  # noqa: PLC0415 - baselines are shown without it
    from slamhive.services.gates import ShrinkRequest, searched_metric  # noqa: PLC0415 - loads scipy

    if options["against"] is not None and options["worse_than"] is not None:
        raise InvalidInput("--against and --worse-than exclude each other", "give one of the two")
    hive = cli.hive()
    metric = searched_metric(options["metric"])
    target = options["target"] or Path(f"{hive.stored_runs.get(run_id).dataset}-run-{run_id}")
    request = ShrinkRequest(
        run_id=run_id,
        metric=metric,
        difference=read_difference(options["difference"], metric),
        target=target.absolute(),
        budget=None if options["budget"] is None else read_budget(options["budget"]),
        **{name: options[name] for name in ("against", "worse_than", "share", "error", "most", "step_s")},
    )
    work, line = partial(run_to_end, hive, evaluate=True), partial(tell, style="dim")
    answer = hive.shrinkings.find(request, work, line, partial(progress_bar, "writing the clip"))
    if as_json:
        print_json(answer.content)
    else:
        heads = ("from s", "to s", "runs", "e-value", "found")
        rows = [
            (
                f"{step.begin_s:.1f}",
                f"{step.end_s:.1f}",
                len(step.runs),
                None if step.e_value is None else f"{step.e_value:.3g}",
                step.words,
            )
            for step in answer.steps
        ]
        print_table(heads, rows, right=heads[:4], cut=("found",))
        for note in answer.notes:
            tell(note)
        if answer.folder is not None:
            say(f"{answer.folder}: {(answer.size_bytes or 0) / 1e6:.1f} MB")
    made = ", ".join((plural(answer.decisions, "decision"), plural(answer.runs, "run"))) + "."
    tell(f"{answer.words} {made}", style="green" if answer.folder is not None else "yellow")
    raise click.exceptions.Exit(0 if answer.folder is not None else EXIT_CODES[Answer.UNDECIDED])


def _print_bisect(answer: BisectAnswer) -> None:
    rows = [
        (
            step.commit[:10],
            step.standing.value,
            len(step.runs),
            step.failed,
            None if step.mean is None else mean_and_std(step.mean, step.std),
            None if step.e_value is None else f"{step.e_value:.3g}",
            step.subject,
        )
        for step in answer.steps
    ]
    heads = ("commit", "standing", "runs", "failed", f"{answer.label} {answer.unit}".rstrip(), "e-value", "subject")
    print_table(heads, rows, right=heads[2:6], cut=("subject",))
    for note in answer.notes:
        tell(note)
    if answer.after is not None:
        say(f"commit {answer.after.commit}")
        say(f"Author: {answer.after.author}")
        say(f"Date:   {answer.after.date}")
        say(f"    {answer.after.subject}")
    found = answer.answer is BisectOutcome.FOUND
    made = (
        f"{plural(answer.decisions, 'decision')} over {plural(answer.commits, 'commit')}, {plural(answer.runs, 'run')}."
    )
    tell(f"{answer.words} {made}", style="green" if found else "yellow")


def _write(answer: GateAnswer, markdown: Path | None, junit: Path | None) -> None:
    from slamhive.services.gates import answer_junit, answer_markdown  # noqa: PLC0415

    if markdown is not None:
        write_aside(markdown, answer_markdown(answer))
    if junit is not None:
        write_aside(junit, answer_junit(answer))


def _print(answer: GateAnswer) -> None:
    from slamhive.services.gates import METRIC_HEADS, VALUE_HEADS, metric_row, value_rows  # noqa: PLC0415

    print_table(METRIC_HEADS, [metric_row(entry) for entry in answer.metrics], right=METRIC_HEADS[1:-1])
    say()
    values = [tuple(f"{cell:.4g}" if isinstance(cell, float) else cell for cell in row) for row in value_rows(answer)]
    print_table(VALUE_HEADS, values, right=VALUE_HEADS[2:])
    for note in (*answer.notes, *(f"No runs of {words}." for words in answer.missing)):
        tell(note)
    tell(f"gate {answer.baseline}: {answer.answer}. {answer.words}", style=STYLES[answer.answer])


def _counts(found: Baseline) -> str:
    failed = f", {found.failed} failed" if found.failed else ""
    return f"{plural(found.runs, 'run')} of {plural(len(found.configurations), 'configuration')}{failed}"


# Claims of papers.


CLAIM_STYLES = {
    ClaimState.HOLDS: "green",
    ClaimState.DIFFERS: "red",
    ClaimState.UNDECIDED: "yellow",
    ClaimState.CANNOT_RUN: "dim",
}


@click.group(cls=AnsweringGroup)
def claims() -> None:
    """Find out if the numbers of papers and READMEs hold here. docs/claims.md shows such a file.

    The exit code of a mistake is 2.
    """


@claims.command("check", short_help="Check the claims in FILE against runs")
@click.argument("path", metavar="FILE", type=click.Path(dir_okay=False, path_type=Path))
@click.option("--run", "runs_too", is_flag=True, help="Make the runs and evaluations that are missing.")
@click.option("--executor", help="Where runs are executed; by default the executor in force.")
@click.option("--algorithm", "algorithms", multiple=True, metavar="NAME", help="Only claims about it; may be repeated.")
@click.option("--dataset", "datasets", multiple=True, metavar="NAME", help="Only claims on it; may be repeated.")
@json_option
@pass_cli
def check_claims(cli: CliContext, /, path: Path, runs_too: bool, as_json: bool, **options: Any) -> None:
    """Say of each claim in FILE if it holds, differs, is undecided, or cannot be run.

    Without --run, only runs that exist are looked at. The answer is kept for the pages, unless --algorithm or
    --dataset leaves claims out. The exit code is 0 if all hold, 1 if one differs, 3 otherwise, and 2 for a mistake.
    """
    hive = cli.hive()
    if options["executor"] is not None and not runs_too:
        raise InvalidInput("--executor is for runs that the check makes", "give --run, or leave it out")
    whole = hive.claims.read(path)
    chosen = whole.only(options["algorithms"], options["datasets"])
    refused = None
    if runs_too:
        from slamhive.cli.waiting import evaluate_to_end, run_to_end  # noqa: PLC0415 - loads the worker

        work = hive.claims.start(chosen, options["executor"])
        if work.runs:
            run_to_end(hive, work.runs, evaluate=True)
        if work.evaluations:
            evaluate_to_end(hive.evaluations, work.evaluations)
        refused = work.refused
    with counting_bar("checking", len(chosen.entries), tells_left=False) as show:
        answer = hive.claims.answer(chosen, refused, show)
    if chosen == whole:
        hive.claims.keep(answer)
    print_json(answer.content) if as_json else _print_claims(answer)
    states = {claim.state for claim in answer.claims}
    differs = ClaimState.DIFFERS in states
    raise click.exceptions.Exit(1 if differs else 0 if states == {ClaimState.HOLDS} else 3)


@claims.command("list", short_help="List the files of claims that were checked here")
@json_option
@pass_cli
def list_claims(cli: CliContext, as_json: bool) -> None:
    """List the files of claims that were checked here."""
    found = cli.hive().claims.all()
    if as_json:
        print_json([answer.content for answer in found])
    elif found:
        rows = [(answer.name, answer.title, answer.words, f"{answer.checked_at:%Y-%m-%d %H:%M}") for answer in found]
        print_table(("name", "title", "claims", "checked at"), rows, cut=("title",))
    else:
        tell("no claims; `slamhive claims check FILE` checks some")


@claims.command("show", short_help="Show the last answer about the claims NAME")
@click.argument("name", shell_complete=completion.CLAIMS)
@json_option
@pass_cli
def show_claims(cli: CliContext, name: str, as_json: bool) -> None:
    """Show the last answer about the claims NAME."""
    answer = cli.hive().claims.get(name)
    print_json(answer.content) if as_json else _print_claims(answer)


@claims.command(short_help="Write the badge of the claims NAME to FILE")
@click.argument("name", shell_complete=completion.CLAIMS)
@click.argument("file", type=click.Path(dir_okay=False, path_type=Path))
@pass_cli
def badge(cli: CliContext, name: str, file: Path) -> None:
    """Write the badge of the claims NAME to FILE as SVG, for a README."""
    from slamhive.services.claims import badge_svg  # noqa: PLC0415 - few commands need it

    write_aside(file, badge_svg(claim.state for claim in cli.hive().claims.get(name).claims))
    say(f"badge of claims {name} written to {file}")


@claims.command("remove", short_help="Forget the last answer about the claims NAME")
@click.argument("name", shell_complete=completion.CLAIMS)
@pass_cli
def remove_claims(cli: CliContext, name: str) -> None:
    """Forget the last answer about the claims NAME.

    Their file and the runs stay.
    """
    cli.hive().claims.remove(name)
    say(f"claims {name} removed")


def _print_claims(answer: ClaimsAnswer) -> None:
    rows = [(claim.about, claim.label, claim.stated, claim.state.value, claim.words) for claim in answer.claims]
    print_table(("system and sequence", "metric", "stated", "answer", "here"), rows)
    for claim in answer.claims:
        for found in claim.protocols:
            tool = f" (as {found.preset})" if found.preset else ""
            value = f"{found.value:.4g} {claim.unit}".strip()
            say(f"{claim.about}, {claim.label}: {found.key} is {value} under {found.words}{tool}")
        for note in claim.notes:
            tell(f"{claim.about}, {claim.label}: {note}")
    if answer.hidden:
        tell(f"{plural(answer.hidden, 'claim')} left out: you may not see all of their runs, or some are deleted")
    states = {claim.state for claim in answer.claims}
    worst = next((state for state in reversed(ClaimState) if state in states), ClaimState.CANNOT_RUN)
    worst = ClaimState.DIFFERS if ClaimState.DIFFERS in states else worst
    tell(f"claims {answer.name}: {answer.words}", style=CLAIM_STYLES[worst])


COMMANDS = (gate, claims)
