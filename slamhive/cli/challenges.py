"""``slamhive challenge``: competitions with secret ground truth."""

from __future__ import annotations

import threading
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click

from slamhive.cli.challenge_entries import ENTRY_COMMANDS, name_argument
from slamhive.cli.context import CliContext, json_option, pass_cli
from slamhive.cli.output import print_json, print_table, tell
from slamhive.cli.visible import confirm, say
from slamhive.domain.challenge import shown
from slamhive.domain.numbers import plural
from slamhive.errors import InvalidInput

if TYPE_CHECKING:
    from slamhive.schema.challenge import (
        Challenge,
        ChallengePhase,
        ChallengeRanking,
        ImageRules,
        RankedTeam,
    )


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


@challenge.command()
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
        say(_image_rules(found.images))
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
        _print_ranking(hive.challenges.get(name), found)


@challenge.command()
@name_argument
@click.argument("phase_name", metavar="PHASE")
@click.option("--ends", required=True, metavar="TIME", help="With UTC offset, such as 2026-12-24T18:00+00:00.")
@pass_cli
def phase(cli: CliContext, name: str, phase_name: str, ends: str) -> None:
    """Let PHASE of the challenge NAME end at another time."""
    made = cli.hive().challenges.end_phase(name, phase_name, _time(ends))
    say(f"challenge {name}: {_phase_words(made)}")


@challenge.command()
@name_argument
@pass_cli
def close(cli: CliContext, name: str) -> None:
    """End all phases of the challenge NAME now, which also shows hidden scores."""
    made = cli.hive().challenges.close(name)
    say(f"challenge {name}: {_phase_words(made)}")


@challenge.command()
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


def _print_ranking(found: Challenge, ranked: ChallengeRanking) -> None:
    unit = f" [{found.score_unit}]" if found.score_unit else ""
    rows = [
        (
            f"{entry.rank}{'=' if entry.tied else ''}",
            entry.team,
            shown(entry.score, found.digits),
            _interval(entry, found.digits),
            f"{entry.at:%Y-%m-%d}",
        )
        for entry in ranked.teams
    ]
    heads = ("rank", "team", f"score{unit}", "95 % interval", "sent")
    print_table(heads, rows, right=("rank", heads[2], heads[3]))
    tell(f"phase {ranked.phase}; ranks are separated by {ranked.test}; = marks a rank that is shared")


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


def _image_rules(rules: ImageRules) -> str:
    runs = plural(rules.repeats, "run")
    cores = "1 core" if rules.cpu_cores == 1 else f"{rules.cpu_cores:g} cores"
    return (
        f"Images: {runs} on each sequence with {cores}, {rules.memory_mb:,} MB and "
        f"{rules.time_limit_s:g} s. Playback is {rules.playback.value} at {rules.rate:g}. Results are shown every "
        f"{plural(rules.answers_every_h, 'hour')}."
    )


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
