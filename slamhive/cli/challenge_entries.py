"""``slamhive challenge submit``, ``cancel``, ``status`` and ``log``: submissions to a challenge."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slamhive.cli import offers
from slamhive.cli.context import CliContext, json_option, pass_cli
from slamhive.cli.output import print_json, print_table, tell
from slamhive.cli.visible import say

if TYPE_CHECKING:
    from slamhive.schema.challenge import ChallengeSubmission

name_argument = click.argument("name", shell_complete=offers.CHALLENGE)
phase_option = click.option("--phase", metavar="PHASE", help="The phase; needed if several are open.")


@click.command()
@name_argument
@click.argument("files", nargs=-1, type=click.Path(exists=True, path_type=Path))
@click.option(
    "--image", type=click.Path(exists=True, dir_okay=False, path_type=Path), help="Submit this image instead."
)
@click.option("--package", metavar="NAME[@VERSION]", help="Submit a package of this installation instead.")
@click.option("--algorithm", help="The algorithm of the package, if it has several.")
@click.option("--team", required=True, help="Whose submission it is.")
@phase_option
@click.option("--dry-run", is_flag=True, help="Check the files only; nothing is sent, and nothing counts.")
@json_option
@pass_cli
def submit(cli: CliContext, /, name: str, files: tuple[Path, ...], dry_run: bool, **options: Any) -> None:
    """Submit trajectories, or an image, to the challenge NAME.

    FILES are named after their sequences, such as room-1.txt; a folder stands for the files in it. An image is a file
    that `slamhive algorithm export` or `docker save` wrote.
    """
    _check_one_kind(files, options)
    if options["image"] is None and options["package"] is None:
        made = _submit_files(cli, name, files, options, dry_run=dry_run)
    else:
        made = _submit_image(cli, name, options, dry_run=dry_run)
    if made is None:
        return
    if options["as_json"]:
        print_json(made.content)
    else:
        say(f"submission {made.id} of team {made.team} to phase {made.phase} is queued")
        tell("a worker evaluates it; `slamhive challenge evaluate` does so without one")


def _check_one_kind(files: tuple[Path, ...], options: Mapping[str, Any]) -> None:
    given = [bool(files), options["image"] is not None, options["package"] is not None]
    if sum(given) != 1:
        raise click.UsageError("Give either FILES, or --image, or --package.")
    if options["algorithm"] is not None and files:
        raise click.UsageError("--algorithm belongs to --image or --package.")


def _submit_files(
    cli: CliContext, name: str, files: tuple[Path, ...], options: Mapping[str, Any], *, dry_run: bool
) -> ChallengeSubmission | None:
    from slamhive.services.challenges import Entrant, opened_files  # noqa: PLC0415 - loads numpy

    challenges = cli.hive().challenges
    with opened_files(files) as content:
        if not dry_run:
            return challenges.submit(name, Entrant(options["team"]), content, options["phase"])
        for line in challenges.check(name, content, options["phase"]):
            say(line)
    return None


def _submit_image(
    cli: CliContext, name: str, options: Mapping[str, Any], *, dry_run: bool
) -> ChallengeSubmission | None:
    from slamhive.services.challenges import Entrant  # noqa: PLC0415 - as above

    hive = cli.hive()
    entrant = Entrant(options["team"], algorithm=options["algorithm"])
    if options["package"] is not None:
        version = hive.versions.find(options["package"])
        if not dry_run:
            return hive.challenges.submit_version(name, entrant, version, options["phase"])
        say(f"package {version.label}")
    elif not dry_run:
        return hive.challenges.submit_image(name, entrant, options["image"], options["phase"])
    else:
        say(hive.challenges.check_image(name, options["image"], entrant.algorithm, options["phase"]))
    return None


@click.command()
@name_argument
@click.argument("submission")
@json_option
@pass_cli
def cancel(cli: CliContext, name: str, submission: str, as_json: bool) -> None:
    """Cancel SUBMISSION to the challenge NAME. It still counts for its day."""
    made = cli.hive().challenges.cancel(name, submission)
    if as_json:
        print_json(made.content)
    else:
        say(f"submission {made.id} of team {made.team} is cancelled")


@click.command()
@name_argument
@click.option("--team", help="Only this team.")
@json_option
@pass_cli
def status(cli: CliContext, name: str, team: str | None, as_json: bool) -> None:
    """Show the submissions to the challenge NAME, the newest first."""
    found = cli.hive().challenges.submissions(name)
    found = [entry for entry in found if team is None or entry.team.casefold() == team.casefold()]
    if as_json:
        print_json([entry.content for entry in found])
        return
    if not found:
        tell("no submissions")
        return
    rows = [
        (entry.id, entry.team, entry.phase, f"{entry.at:%Y-%m-%d %H:%M}", entry.state.value, entry.score, entry.reason)
        for entry in found
    ]
    print_table(("submission", "team", "phase", "sent (UTC)", "state", "score", "reason"), rows, right=("score",))


@click.command()
@name_argument
@click.argument("submission")
@pass_cli
def log(cli: CliContext, name: str, submission: str) -> None:
    """Show the log of SUBMISSION to the challenge NAME, and what its image printed on public recordings."""
    found = cli.hive().challenges.submission(name, submission)
    say("\n".join(found.log))
    for run, text in found.run_logs.items():
        say(f"\n== {run}\n{text}")


ENTRY_COMMANDS = (submit, cancel, status, log)
