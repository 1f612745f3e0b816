"""``slamhive variants``: list steps; list, create, delete and verify variants of datasets."""

from __future__ import annotations

import click

from slamhive.base.errors import Conflict, InvalidInput
from slamhive.cli import completion
from slamhive.cli.context import CliContext, json_option, pass_cli
from slamhive.cli.output import print_json, print_table, progress_bar, tell
from slamhive.cli.running import parse_steps, step_option
from slamhive.cli.visible import say
from slamhive.documents.catalogue import CachedVariant, StepDocument
from slamhive.documents.model import load
from slamhive.domain.configuration import Variant
from slamhive.recordings.variants.cache import VariantEntry
from slamhive.recordings.variants.steps import RegisteredSteps, describe_options, describe_step

KEY_SHOWN = 12


@click.group()
def variants() -> None:
    """Manage pre-processed variants of datasets."""


@variants.command("steps")
@click.argument("kind", required=False)
@json_option
def steps_(kind: str | None, as_json: bool) -> None:
    """List the steps, or the options of one."""
    kinds = RegisteredSteps().kinds() if kind is None else [kind]
    if as_json:
        print_json([_step(name).content for name in kinds])
    elif kind is None:
        rows = [(name, ", ".join(RegisteredSteps().options(name)), describe_step(name)) for name in kinds]
        print_table(("step", "options", "what it does"), rows)
    else:
        say(f"{kind}: {describe_step(kind)}")
        option_rows = [
            (entry.name, entry.type, entry.allowed, entry.unit, _default(entry.default, entry.required), entry.help)
            for entry in describe_options(kind)
        ]
        print_table(("option", "type", "allowed", "unit", "default", "meaning"), option_rows)


@variants.command("list")
@click.option("--dataset", help="Only those of this dataset.")
@json_option
@pass_cli
def list_(cli: CliContext, dataset: str | None, as_json: bool) -> None:
    """List the cached variants, the most recently used first."""
    hive = cli.hive(indexed=False)
    found = hive.variants.entries(dataset)
    if as_json:
        print_json([CachedVariant.of(entry).content for entry in found])
        return
    if not found:
        tell("no variants; runs make those they need, `slamhive variants make` makes one")
        return
    rows = [
        (
            entry.key[:KEY_SHOWN],
            entry.dataset,
            f"{entry.size_bytes / 1e6:.1f}",
            f"{entry.used_at:%Y-%m-%d %H:%M:%S}",
            "yes" if entry.in_use else "no",
            "; ".join(str(step) for step in load(Variant, entry.steps)),
        )
        for entry in found
    ]
    print_table(("key", "dataset", "MB", "last used (UTC)", "in use", "steps"), rows, right=("MB",))
    total_bytes, allowed_bytes = sum(entry.size_bytes for entry in found), hive.settings.variant_cache_bytes
    tell(f"{len(found)} variants, {total_bytes / 1e6:.1f} MB of {allowed_bytes / 1e6:.0f} MB")


@variants.command("make", short_help="Create the variant of DATASET with these steps")
@click.argument("dataset", shell_complete=completion.DATASET)
@step_option
@json_option
@pass_cli
def make(cli: CliContext, dataset: str, variant: tuple[str, ...], as_json: bool) -> None:
    """Create the variant of DATASET with these steps, unless it is cached."""
    hive = cli.hive(indexed=False)
    hive.check_writable()
    source = hive.catalogue.dataset(dataset)
    steps = hive.variants.resolve(source, parse_steps(variant))
    if not steps:
        raise InvalidInput(f"these steps change nothing in {dataset}", "give --step, with a factor other than 1")
    with (
        progress_bar(f"variant of {dataset}") as progress,
        hive.variants.hold(source, steps, progress) as used,
    ):
        progress(1.0, "done")
    entry = hive.variants.cache.find(used.key)
    if as_json:
        print_json(CachedVariant.of(entry).content)
    else:
        say(f"{entry.key}: {entry.size_bytes / 1e6:.1f} MB, {used.dataset.bag_path}")


@variants.command("drop")
@click.argument("keys", nargs=-1)
@click.option("--dataset", help="All variants of this dataset.")
@click.option("--all", "everything", is_flag=True, help="All variants.")
@json_option
@pass_cli
def drop(cli: CliContext, keys: tuple[str, ...], dataset: str | None, everything: bool, as_json: bool) -> None:
    """Delete variants by KEY (a prefix is enough). Variants in use are kept; runs create again what they need."""
    hive = cli.hive(indexed=False)
    hive.check_writable()
    chosen = _chosen(cli, keys, dataset, everything)
    dropped: list[VariantEntry] = []
    kept: list[VariantEntry] = []
    for entry in chosen:
        try:
            hive.variants.drop(entry.key)
        except Conflict:
            if keys:
                raise
            kept.append(entry)
        else:
            dropped.append(entry)
    if as_json:
        print_json({"dropped": [entry.key for entry in dropped], "in_use": [entry.key for entry in kept]})
        return
    in_use = f", {len(kept)} in use stay" if kept else ""
    say(f"{len(dropped)} variants removed, {sum(entry.size_bytes for entry in dropped) / 1e6:.1f} MB{in_use}")


@variants.command("verify", short_help="Read every byte of variants, and compare")
@click.argument("keys", nargs=-1)
@click.option("--dataset", help="All variants of this dataset.")
@json_option
@pass_cli
def verify(cli: CliContext, keys: tuple[str, ...], dataset: str | None, as_json: bool) -> None:
    """Read every byte of variants (of all without KEY) and compare; exit code 1 if one is damaged."""
    hive = cli.hive(indexed=False)
    chosen = _chosen(cli, keys, dataset, not keys and dataset is None)
    problems: dict[str, str | None] = {}
    with progress_bar("verifying") as progress:
        for number, entry in enumerate(chosen):
            progress(number / len(chosen), entry.key[:KEY_SHOWN])
            problems[entry.key] = hive.variants.cache.verify(entry.key)
    damaged = {key: problem for key, problem in problems.items() if problem is not None}
    if as_json:
        print_json([{"key": key, "problem": problem} for key, problem in problems.items()])
    else:
        for key, problem in damaged.items():
            say(f"{key[:KEY_SHOWN]}: {problem}; `slamhive variants drop {key[:KEY_SHOWN]}` removes it")
        say(f"{len(problems) - len(damaged)} of {len(problems)} variants are whole")
    if damaged:
        raise click.exceptions.Exit(1)


def _chosen(cli: CliContext, keys: tuple[str, ...], dataset: str | None, everything: bool) -> tuple[VariantEntry, ...]:
    service = cli.hive(indexed=False).variants
    if keys and (dataset is not None or everything):
        raise InvalidInput("keys and a choice of many exclude each other", "give either KEY... or --dataset or --all")
    if keys:
        return tuple(service.cache.find(key) for key in keys)
    if dataset is None and not everything:
        raise InvalidInput("no variant is named", "give KEY..., --dataset NAME or --all")
    return service.entries(dataset)


def _step(kind: str) -> StepDocument:
    return StepDocument(kind=kind, help=describe_step(kind), options=describe_options(kind))


def _default(value: object, required: bool) -> str:
    return "required" if required else "none" if value is None else str(value)


COMMANDS = (variants,)
