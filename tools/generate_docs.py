"""Writes what follows from the code: settings, command line, pre-processing steps, metrics, the schemas of files.

``generate_docs.py`` writes them, ``generate_docs.py --check`` fails if they are out of date.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import click
from architecture import PAGE, arrows_of, as_svg
from page_notebook import notebook_of

from slamhive import cli
from slamhive.analysis.analysis_file import analysis_schema
from slamhive.analysis.plot_types import PLOT_TYPES, PlotOptions
from slamhive.analysis.report import Report, ReportBrief
from slamhive.base.project import project_root
from slamhive.base.settings_sources import describe
from slamhive.cloud.plan import cloud_schema
from slamhive.documents import catalogue, experiment, machines
from slamhive.documents.archive import ArchiveManifest, LedgerLine, RunLine
from slamhive.documents.catalogue import (
    CachedVariant,
    DatasetCheck,
    FoundThing,
    MatchDocument,
    PlugIn,
    StepDocument,
    TruthTrialDocument,
)
from slamhive.documents.challenge import Challenge, ChallengeBrief, ChallengeFile, ChallengeRanking, ChallengeSubmission
from slamhive.documents.claims import ClaimsAnswer, ClaimsFile
from slamhive.documents.experiment import Decision, Notice, SearchStanding, StoredAnalysis
from slamhive.documents.gate import Baseline, BaselineBrief, GateAnswer, ReplayAnswer
from slamhive.documents.imports import Import
from slamhive.documents.machines import CloudPlanDocument, CloudStatus
from slamhive.documents.model import json_schema
from slamhive.documents.plain import ExperimentStatusDocument, OverviewDocument
from slamhive.documents.protocol import ComparisonDocument, ProtocolsDocument, ProtocolSearchDocument, ToolMetrics
from slamhive.documents.record import RunFile
from slamhive.documents.run import EvaluationDocument, RunWith
from slamhive.documents.submission import Submission
from slamhive.domain.algorithm import Algorithm, AlgorithmPackage
from slamhive.domain.metrics import CATALOGUE, Group, Metric
from slamhive.executors.registry import declared_settings
from slamhive.experiments.file import experiment_schema
from slamhive.packages.algorithm_file import ALGORITHM_FILE, load_algorithms
from slamhive.packages.protocol_file import protocol_schema
from slamhive.recordings.variants.steps import RegisteredSteps, describe_options, explain_step

DOCS = Path(__file__).resolve().parent.parent / "docs"
PYTHON_PAGE = DOCS / "python.md"
HELP_WIDTH = 100
NOTE = "<!-- Written by tools/generate_docs.py; change the code, not this page. -->\n"

SETTINGS_HEAD = """# Settings

Values come from four places; a later one wins: the default, `configuration.py` in the project's root, the
environment variable, the command-line option. `slamhive settings` shows each value in force and where it
comes from.

In `configuration.py` a setting has the name of the first column: `WORKER_SLOTS = 2`. A value of the wrong type or
out of range, and a name that does not exist, stop every command with one line that says so.

Passwords and keys belong into the environment, never into a file under version control.

The last ones of the table belong to one executor each. Executors of plug-ins may have settings too; `slamhive
settings` lists them.

One variable is no setting: `SLAMHIVE_ROOT` names the project's folder (with `algorithms/`, `templates/` and
`configuration.py`). Without it, that is the checkout that the program was started from, or the folder of the installed
package.

| setting | environment variable | default | unit | what it does |
|---|---|---|---|---|
"""

STEPS_HEAD = """# Pre-processing steps

What each step does, on which data, with which options. [Variants](variants.md) says how steps are used.
"""
OPTIONS_HEAD = "| option | type | allowed | unit | default | meaning |\n|---|---|---|---|---|---|\n"

PLOT_TYPES_HEAD = """# Plot types of analyses

What each plot type shows, and its options. All plot types also have `form` (the key of the plot type), `title`
(replaces the default title) and `text` (Markdown above the plot). [Analysis](analysis.md) says how to use them.
"""
PLOT_TYPES_TABLE = "| option | default | meaning |\n|---|---|---|\n"

METRICS_HEAD = """# Metrics

Every metric that a run can have. Metrics of an evaluation depend on the [protocol](evaluation.md) and carry its
fingerprint; values with different fingerprints are never averaged or ranked together. The others, marked "while
running", need no evaluation. A metric that cannot be computed is absent, never 0, and the evaluation says why.
"""
ALGORITHMS_HEAD = """# Algorithms

These packages are in `algorithms/`. Each mode of a package is an algorithm. The README in a package's folder explains
its time convention and its parameters; `slamhive algorithm show NAME` lists the parameters.

A bound says what a run on a dataset keeps: the least number of poses and the largest absolute trajectory error (ATE
RMSE) after the alignment in brackets. `room` is the dataset that `slamhive dataset room` makes, `kitti_06` are the
first 51 frames of KITTI odometry 06. `room` has no 2D laser: `aces` is a public log of one with reference
relations. `slamhive algorithm test NAME` runs an algorithm and compares.

| algorithm | sensors | package | licence | bounds |
|---|---|---|---|---|
"""
ALGORITHMS_LEFT_OUT = (
    "\n## Looked at and left out {#left-out}\n\n| package on PyPI | what was found |\n|---|---|\n"
    "| `super-lio` 2.0.2 to 2.0.5 | its module `_super_lio_core` ends the process with SIGSEGV on import, with Python "
    "3.11 on Debian 12 |\n"
    "| `dim-odom` 0.4.2 | cuVSLAM and a Kalman filter. It tracks stereo images without a GPU (5.0 mm between made-up "
    "images came out as 5.1 mm on average). But the licence of cuVSLAM, which its own does not name, allows NVIDIA's "
    "hardware only: use [cuVSLAM](#cuvslam) there |\n"
)
METRICS_TABLE = "| key | name | unit | better | what it is | after |\n|---|---|---|---|---|---|\n"

CLI_HEAD = """# Command line

Every command has `--help`; those that list or show have `--json`. A mistake of the user ends with one line on
standard error and exit code 1.
"""


def settings_page() -> str:
    """``docs/settings.md``: every setting in one table."""
    rows = (
        f"| `{entry.name}` | `{entry.environment}` | {f'`{entry.default}`' if entry.default else 'empty'} "
        f"| {entry.unit} | {_cell(entry.help)} |\n"
        for entry in describe(declared_settings())
    )
    return NOTE + SETTINGS_HEAD + "".join(rows)


def steps_page() -> str:
    """``docs/variant-steps.md``: every pre-processing step with its options."""
    sections = []
    for kind in RegisteredSteps().kinds():
        rows = (
            f"| `{entry.name}` | {entry.type} | {_cell(entry.allowed)} | {entry.unit} "
            f"| {'required' if entry.required else '' if entry.default is None else f'`{entry.default}`'} "
            f"| {_cell(entry.help)} |\n"
            for entry in describe_options(kind)
        )
        sections.append(f"\n## {kind}\n\n{explain_step(kind)}\n\n{OPTIONS_HEAD}{''.join(rows)}")
    return NOTE + STEPS_HEAD + "".join(sections)


def plot_types_page() -> str:
    """``docs/analysis-forms.md``: every plot type with its options."""
    sections = []
    for key, plot_type in PLOT_TYPES:
        own = {
            name: entry
            for name, entry in plot_type.options.model_fields.items()
            if name not in PlotOptions.model_fields
        }
        rows = []
        for name, entry in own.items():
            default = "required" if entry.is_required() else f"`{entry.get_default(call_default_factory=True)}`"
            rows.append(f"| `{name}` | {default} | {_cell(entry.description or '')} |\n")
        table = "".join(rows)
        options = f"\n{PLOT_TYPES_TABLE}{table}" if table else ""
        sections.append(f"\n## {key}\n\n{plot_type.title}. {plot_type.description}\n{options}")
    return NOTE + PLOT_TYPES_HEAD + "".join(sections)


def metrics_page() -> str:
    """``docs/metrics.md``: the metric catalogue, group by group."""
    sections = []
    for group in Group:
        rows = [_metric_row(metric) for metric in CATALOGUE.values() if metric.group is group]
        if rows:
            sections.append(f"\n## {group.value.capitalize()}\n\n{METRICS_TABLE}{''.join(rows)}")
    return NOTE + METRICS_HEAD + "".join(sections)


def cli_page() -> str:
    """``docs/cli.md``: the help text of every command."""
    sections = (f"\n## {path}\n\n```text\n{text}\n```\n" for path, text in _commands(cli.main, "slamhive", None))
    return NOTE + CLI_HEAD + "".join(sections)


def algorithms_page() -> str:
    """``docs/algorithms.md``: every package of the project, with its modes and bounds."""
    files = sorted((project_root() / "algorithms").glob(f"*/{ALGORITHM_FILE}"))
    packages = [load_algorithms(path.parent) for path in files]
    overview = "".join(_algorithm_row(entry) for algorithms in packages for entry in algorithms)
    sections = (_about(algorithms[0].package) for algorithms in packages)
    return NOTE + ALGORITHMS_HEAD + overview + "".join(sections) + ALGORITHMS_LEFT_OUT


def _algorithm_row(entry: Algorithm) -> str:
    sensors = ", ".join(role.kind.value for role in entry.inputs)
    bounds = "<br>".join(f"`{bound.dataset}`: {_cell(bound.words)}" for bound in entry.bounds)
    package = f"[{entry.package.title}](#{entry.package.name})"
    return f"| `{entry.name}` | {sensors} | {package} | {entry.package.licence} | {bounds} |\n"


def _about(package: AlgorithmPackage) -> str:
    image = f"Package `{package.name}`, version {package.version} of [{package.upstream}]({package.upstream})."
    resources = f"Asks for {package.cpu_cores:g} cores and {package.memory_mb} MB of memory."
    return f"\n## {package.title} {{#{package.name}}}\n\n{image} {resources}\n\n{' '.join(package.citation.split())}\n"


DOCUMENTS: dict[str, Any] = {
    "account": machines.AccountDocument,
    "algorithm": catalogue.AlgorithmDocument,
    "algorithm-test": catalogue.BoundResult,
    "api-token": machines.ApiToken,
    "archive": ArchiveManifest,
    "archive-run": RunLine,
    "audit-line": machines.AuditLineDocument,
    "challenge-brief": ChallengeBrief,
    "challenge-public": Challenge,
    "challenge-ranking": ChallengeRanking,
    "challenge-submission": ChallengeSubmission,
    "claims-answer": ClaimsAnswer,
    "cloud-plan": CloudPlanDocument,
    "cloud-status": CloudStatus,
    "comparison": ComparisonDocument,
    "configuration": catalogue.ConfigurationDocument,
    "dataset": catalogue.DatasetDocument,
    "dataset-check": DatasetCheck,
    "decision": Decision,
    "truth-trial": TruthTrialDocument,
    "protocol-search": ProtocolSearchDocument,
    "evaluation": EvaluationDocument,
    "experiment-cell": experiment.CellDocument,
    "experiment-grid": experiment.GridDocument,
    "experiment-preview": experiment.ExperimentPreviewDocument,
    "experiment-status": ExperimentStatusDocument,
    "found": FoundThing,
    "gate-answer": GateAnswer,
    "gate-baseline": Baseline,
    "gate-baseline-brief": BaselineBrief,
    "import": Import,
    "ledger-line": LedgerLine,
    "link-report": catalogue.LinkReportDocument,
    "match": MatchDocument,
    "nodes": OverviewDocument,
    "notice": Notice,
    "plug-in": PlugIn,
    "protocols": ProtocolsDocument,
    "public-sequence": catalogue.PublicSequence,
    "replay-answer": ReplayAnswer,
    "report": Report,
    "report-brief": ReportBrief,
    "run": RunWith,
    "run-record": RunFile,
    "search": SearchStanding,
    "stored-analysis": StoredAnalysis,
    "tool-metrics": ToolMetrics,
    "variant": CachedVariant,
    "variant-step": StepDocument,
}
"""What commands, the web API, run folders and archives write."""

PAGES: dict[str, Callable[[], str]] = {
    "examples/python.ipynb": lambda: notebook_of(PYTHON_PAGE.read_text(encoding="utf-8"), "../"),
    "settings.md": settings_page,
    "algorithms.md": algorithms_page,
    "cli.md": cli_page,
    "variant-steps.md": steps_page,
    "metrics.md": metrics_page,
    "analysis-forms.md": plot_types_page,
    "images/packages.svg": lambda: as_svg(arrows_of(PAGE.read_text(encoding="utf-8"))),
    "schemas/analysis.schema.json": analysis_schema,
    "schemas/challenge.schema.json": lambda: json_schema(ChallengeFile),
    "schemas/claims.schema.json": lambda: json_schema(ClaimsFile),
    "schemas/cloud.schema.json": cloud_schema,
    "schemas/experiment.schema.json": experiment_schema,
    "schemas/protocol.schema.json": protocol_schema,
    "schemas/submission.schema.json": lambda: json_schema(Submission),
    **{f"schemas/{name}.schema.json": partial(json_schema, kind, "serialization") for name, kind in DOCUMENTS.items()},
}


def out_of_date() -> list[str]:
    """Names of the pages whose text on disk is not what the code says."""
    return [
        name
        for name, page in PAGES.items()
        if not (DOCS / name).is_file() or (DOCS / name).read_text(encoding="utf-8") != page()
    ]


def main(arguments: list[str]) -> int:
    """Write, or with ``--check`` compare."""
    stale = out_of_date()
    if "--check" in arguments:
        for name in stale:
            print(f"docs/{name} is out of date; run: .venv/bin/python tools/generate_docs.py", file=sys.stderr)
        return 1 if stale else 0
    for name in stale:
        (DOCS / name).parent.mkdir(exist_ok=True)
        (DOCS / name).write_text(PAGES[name](), encoding="utf-8")
        print(f"wrote docs/{name}")
    return 0


def _commands(command: click.Command, name: str, parent: click.Context | None) -> Iterator[tuple[str, str]]:
    context = command.make_context(name, [], parent=parent, resilient_parsing=True)
    context.terminal_width = HELP_WIDTH
    yield context.command_path, command.get_help(context).rstrip()
    if isinstance(command, click.Group):
        for child_name in command.list_commands(context):
            child = command.get_command(context, child_name)
            if child is not None and not child.hidden:
                yield from _commands(child, child_name, context)


def _metric_row(metric: Metric) -> str:
    when = "" if metric.needs_protocol else " While running."
    return (
        f"| `{metric.key}` | {_cell(metric.label)} | {metric.unit or '1'} | {metric.direction.value} "
        f"| {_cell(metric.definition)}{when} | {_cell(metric.source)} |\n"
    )


def _cell(text: str) -> str:
    """Text that stays inside its table cell; ``<...>`` is not markup."""
    return text.replace("|", "\\|").replace("<", "&lt;").replace(">", "&gt;")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
