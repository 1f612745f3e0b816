"""``slamhive challenge``: competitions with secret ground truth."""

from __future__ import annotations

import threading
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slamhive.base.errors import InvalidInput
from slamhive.cli import completion
from slamhive.cli.context import CliContext, json_option, pass_cli
from slamhive.cli.output import print_json, print_table, tell
from slamhive.cli.visible import confirm, say
from slamhive.domain.challenge import shown
from slamhive.domain.names import plural

if TYPE_CHECKING:
    from slamhive.documents.challenge import (
        Challenge,
        ChallengePhase,
        RankedTeam,
    )

# ``slamhive challenge submit``, ``cancel``, ``status`` and ``log``: submissions to a challenge.


name_argument = click.argument("name", shell_complete=completion.CHALLENGE)
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
    given = [bool(files), options["image"] is not None, options["package"] is not None]
    if sum(given) != 1:
        raise click.UsageError("Give either FILES, or --image, or --package.")
    if options["algorithm"] is not None and files:
        raise click.UsageError("--algorithm belongs to --image or --package.")
    from slamhive.services.challenges import Entrant, opened_files  # noqa: PLC0415 - loads numpy

    hive, phase = cli.hive(), options["phase"]
    entrant = Entrant(options["team"], algorithm=options["algorithm"])
    if files:
        with opened_files(files) as content:
            if dry_run:
                for line in hive.challenges.check(name, content, phase):
                    say(line)
                return
            made = hive.challenges.submit(name, entrant, content, phase)
    elif options["package"] is not None:
        version = hive.versions.find(options["package"])
        if dry_run:
            say(f"package {version.label}")
            return
        made = hive.challenges.submit_version(name, entrant, version, phase)
    else:
        if dry_run:
            say(hive.challenges.check_image(name, options["image"], entrant.algorithm, phase))
            return
        made = hive.challenges.submit_image(name, entrant, options["image"], phase)
    if options["as_json"]:
        print_json(made.content)
    else:
        say(f"submission {made.id} of team {made.team} to phase {made.phase} is queued")
        tell("a worker evaluates it; `slamhive challenge evaluate` does so without one")


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


@click.command(short_help="Show the log of a submission")
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


@click.group()
def challenge() -> None:
    """Hold competitions whose ground truth is secret. docs/challenges.md is a tutorial."""


@challenge.command()
@click.argument("file", type=click.Path(dir_okay=False, path_type=Path))
@pass_cli
def create(cli: CliContext, file: Path) -> None:
    """Make a challenge of FILE, which names the secret ground truths.

    They are copied into a folder that only your user can read.
    """
    made = cli.hive().challenges.create(file)
    say(f"challenge {made.name}: {plural(len(made.sequences), 'sequence')}, {_phase_words(made)}")


@challenge.command("list")
@json_option
@pass_cli
def list_(cli: CliContext, as_json: bool) -> None:
    """List challenges."""
    found = cli.hive().challenges.briefs()
    if as_json:
        print_json([entry.content for entry in found])
    elif found:
        rows = [
            (entry.name, entry.title, entry.preset, entry.sequences, ", ".join(entry.open_phases) or None)
            for entry in found
        ]
        print_table(("name", "title", "preset", "sequences", "open phases"), rows, right=("sequences",), cut=("title",))
    else:
        tell("no challenges; `slamhive challenge create FILE` makes one")


@challenge.command(short_help="Show how a challenge counts, and its sequences")
@name_argument
@json_option
@pass_cli
def show(cli: CliContext, name: str, as_json: bool) -> None:
    """Show the challenge NAME: how it counts, its sequences and phases."""
    found = cli.hive().challenges.get(name)
    if as_json:
        print_json(found.content)
        return
    say(f"{found.name}: {found.title}")
    say(f"{found.counts} Each sequence: {found.metric}, {found.protocol.label}.")
    if found.images is not None:
        rules = found.images
        cores = "1 core" if rules.cpu_cores == 1 else f"{rules.cpu_cores:g} cores"
        say(
            f"Images: {plural(rules.repeats, 'run')} on each sequence with {cores}, {rules.memory_mb:,} MB and "
            f"{rules.time_limit_s:g} s. Playback is {rules.playback.value} at {rules.rate:g}. Results are shown every "
            f"{plural(rules.answers_every_h, 'hour')}."
        )
    rows = [(entry.name, _extent(found, entry.name), entry.data or None) for entry in found.sequences]
    print_table(("sequence", "recording", "data"), rows, cut=("data",))
    say()
    phases = [
        (
            entry.name,
            entry.state.value,
            _moment(entry.begins),
            _moment(entry.ends),
            len(entry.sequences),
            " or ".join(entry.takes),
            entry.submissions_per_day,
            "yes" if entry.scores_shown else "when it has ended",
        )
        for entry in found.phases
    ]
    heads = ("phase", "state", "begins (UTC)", "ends (UTC)", "sequences", "takes", "per day", "scores shown")
    print_table(heads, phases, right=("sequences", "per day"))


@challenge.command()
@pass_cli
def evaluate(cli: CliContext) -> None:
    """Evaluate all submissions that wait, as a worker does. Images run first, one after the other."""
    hive = cli.hive()
    hive.check_writable()
    stopping = threading.Event()
    while hive.challenge_images.work_once(stopping):
        pass
    done = 0
    while more := hive.challenge_judge.work_once(stopping):
        done += more
    say(f"{plural(done, 'submission')} evaluated")
    if done:
        tell(
            "results of trajectories are shown from the next full minute, those of images at the hours of the challenge"
        )


@challenge.command()
@name_argument
@click.option("--phase", metavar="PHASE", help="The phase.  [default: the last that has started]")
@json_option
@pass_cli
def ranking(cli: CliContext, name: str, phase: str | None, as_json: bool) -> None:
    """Rank the teams of the challenge NAME. Teams share a rank unless a test separates them."""
    hive = cli.hive()
    found = hive.challenges.ranking(name, phase)
    if as_json:
        print_json(found.content)
        return
    if not found.shown:
        until = "the organiser ends it" if found.shown_from is None else f"{_moment(found.shown_from)} UTC"
        tell(f"the scores of phase {found.phase} are hidden until {until}")
    elif not found.teams:
        tell(f"phase {found.phase} has no evaluated submission yet")
    else:
        counted = hive.challenges.get(name)
        unit = f" [{counted.score_unit}]" if counted.score_unit else ""
        rows = [
            (
                f"{entry.rank}{'=' if entry.tied else ''}",
                entry.team,
                shown(entry.score, counted.digits),
                _interval(entry, counted.digits),
                f"{entry.at:%Y-%m-%d}",
            )
            for entry in found.teams
        ]
        heads = ("rank", "team", f"score{unit}", "95 % interval", "sent")
        print_table(heads, rows, right=("rank", heads[2], heads[3]))
        tell(f"phase {found.phase}; ranks are separated by {found.test}; = marks a rank that is shared")


@challenge.command()
@name_argument
@click.argument("phase_name", metavar="PHASE")
@click.option("--ends", required=True, metavar="TIME", help="With UTC offset, such as 2026-12-24T18:00+00:00.")
@pass_cli
def phase(cli: CliContext, name: str, phase_name: str, ends: str) -> None:
    """Let PHASE of the challenge NAME end at another time."""
    made = cli.hive().challenges.end_phase(name, phase_name, _time(ends))
    say(f"challenge {name}: {_phase_words(made)}")


@challenge.command(short_help="End all phases of a challenge now")
@name_argument
@pass_cli
def close(cli: CliContext, name: str) -> None:
    """End all phases of the challenge NAME now, which also shows hidden scores."""
    made = cli.hive().challenges.close(name)
    say(f"challenge {name}: {_phase_words(made)}")


@challenge.command(short_help="Remove a challenge, its secrets and its submissions")
@name_argument
@click.option("--yes", is_flag=True, help="Do not ask.")
@pass_cli
def remove(cli: CliContext, name: str, yes: bool) -> None:
    """Remove the challenge NAME with its secrets, its submissions and their images."""
    hive = cli.hive()
    found = hive.challenges.get(name)
    if not yes:
        confirm(f"Remove {found.title} with all its submissions?")
    hive.challenge_images.remove(name)
    say(f"challenge {name} is removed")


def _interval(entry: RankedTeam, digits: int) -> str | None:
    if entry.low is None or entry.high is None:
        return None
    return f"{shown(entry.low, digits)} to {shown(entry.high, digits)}"


def _phase_words(found: Challenge) -> str:
    return "; ".join(f"phase {entry.name} {_state(entry)}" for entry in found.phases)


def _state(entry: ChallengePhase) -> str:
    if entry.state.value == "open":
        return "open" if entry.ends is None else f"open until {_moment(entry.ends)} UTC"
    return f"opens {_moment(entry.begins)} UTC" if entry.state.value == "coming" else "ended"


def _extent(found: Challenge, name: str) -> str:
    entry = next(entry for entry in found.sequences if entry.name == name)
    if entry.secret:
        return "secret"
    if entry.time_range_s is None:
        return f"{entry.poses:,} frames"
    return f"{entry.time_range_s[0]:.3f} to {entry.time_range_s[1]:.3f} s"


def _moment(at: datetime | None) -> str | None:
    return None if at is None else f"{at:%Y-%m-%d %H:%M}"


def _time(text: str) -> datetime:
    try:
        found = datetime.fromisoformat(text)
    except ValueError:
        raise InvalidInput(f"{text[:40]!r} is no time", "write it as 2026-12-24T18:00+00:00") from None
    if found.tzinfo is None:
        raise InvalidInput(f"{text} lacks its UTC offset", f"write {text}+00:00 for UTC")
    return found


for _command in ENTRY_COMMANDS:
    challenge.add_command(_command)


COMMANDS = (challenge,)
