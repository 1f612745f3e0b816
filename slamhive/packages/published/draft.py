"""Drafts ``algorithm.yaml`` for a folder of somebody else. What could not be known is marked and listed."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from slamhive.base import strict_yaml
from slamhive.base.errors import InvalidInput
from slamhive.domain.algorithm import Base, RunUser
from slamhive.domain.names import check_name, printable
from slamhive.domain.packages import UNKNOWN, PackageOrigin
from slamhive.domain.protocol import TrajectoryKind
from slamhive.domain.sensors import SensorKind, SensorSetup
from slamhive.packages.published.facts import (
    SETUPS,
    FolderFacts,
    choose_user,
    names_a_topic,
    setup_of_name,
    setup_of_roles,
)
from slamhive.packages.published.folder import MAPPING, SCRIPTS, ForeignFolder
from slamhive.packages.published.knowledge import example_of, general_name, source_of

# The parameters of a drafted package: what is known of each, and from where.


_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_.-]{0,63}")
_EXAMPLE = "config_temp.yaml"
_LONGEST_HELP = 200
_ONLY_FOR_VIEWERS = frozenset({"rviz", "gui", "debug"})
SAVE_MAP = "save_map"
Plain = bool | int | float | str | list[float]


@dataclass(frozen=True, slots=True)
class DraftParameter:
    """A parameter of the draft. Without ``default`` and ``source``, each run has to give it.

    ``said_by`` says where it was found, ``note`` where its value comes from. ``choices`` are for the type ``enum``.
    """

    key: str
    type: str
    help: str
    said_by: str
    default: Plain | None = None
    source: str | None = None
    note: str = ""
    general: str | None = None
    choices: tuple[str, ...] = ()


def draft_parameters(folder: ForeignFolder, facts: FolderFacts, roles: tuple[str, ...]) -> Iterator[DraftParameter]:
    """The parameters that the templates, ``mapping.py`` and the launch files of a folder name, each once."""
    # Some folders hold a configuration as an example; an unreadable one says nothing.
    try:
        content = strict_yaml.parse(folder.scripts.get(_EXAMPLE, "a: b"), _EXAMPLE)
    except InvalidInput:
        content = {}
    said = content.get("algorithm-parameters")
    examples = {key: value for key, value in said.items() if is_plain(value)} if isinstance(said, dict) else {}
    names = set(facts.placeholders) | set(facts.mapping.keys)
    topics = {entry.parameter: role for role, entry in facts.topics.items() if entry.parameter and role in roles}
    types = dict(facts.mapping.numbers)
    for name, said_by, text in _named(facts):
        if name in topics:
            help_text = f"Topic of {topics[name]}; the recording is played under this name."
            yield DraftParameter(name, "string", help_text, said_by, default=f"/{topics[name]}")
            continue
        source = source_of(name, roles)
        line = " ".join(printable(text).split())
        help_text = (line if len(line) <= _LONGEST_HELP else f"{line[: _LONGEST_HELP - 1]}…") or f"{name} of {said_by}."
        if source is not None:
            kind = types.get(name, source[1])
            yield DraftParameter(name, kind, help_text, said_by, source=source[0], general=general_name(name))
            continue
        value, note = _value(name, names, facts, examples)
        choices = _lens_templates(name, folder)
        if choices:
            if value not in choices:
                value, note = (choices[0], "the only template of this camera") if len(choices) == 1 else (None, "")
            yield DraftParameter(name, "enum", help_text, said_by, value, None, note, choices=choices)
            continue
        kind = types.get(name) or type_of(value)
        value = float(value) if kind == "float" and isinstance(value, int) else value
        yield DraftParameter(name, kind, help_text, said_by, value, None, note, general_name(name))


def plain_value(text: str) -> Plain:
    """Text as the value that YAML makes of it: number, bool, list of numbers or text."""
    try:
        value = strict_yaml.parse(f"value: {text}", "a value")["value"]
    except InvalidInput:
        return text
    return value if is_plain(value) else text


def is_plain(value: object) -> bool:
    """Tell if ``value`` can be a value of a parameter."""
    if isinstance(value, list):
        return bool(value) and all(isinstance(part, int | float) and not isinstance(part, bool) for part in value)
    return isinstance(value, bool | int | float | str)


def type_of(value: Plain | None) -> str:
    """The type of a parameter with this default; text if it is not known."""
    kinds: tuple[tuple[type, str], ...] = ((bool, "bool"), (int, "int"), (float, "float"), (list, "matrix"))
    return next((name for kind, name in kinds if isinstance(value, kind)), "string")


def _named(facts: FolderFacts) -> Iterator[tuple[str, str, str]]:
    """Name, the file that names it, and its comment."""
    seen: set[str] = set()
    found: list[tuple[str, str, str]] = [
        (name, template, entry.comment) for name, (template, entry) in facts.placeholders.items()
    ]
    found += [(name, "mapping.py", "") for name in facts.mapping.keys if name != SAVE_MAP]
    if "algorithm-parameters" in facts.mapping.sections and not facts.placeholders:
        found += [
            (entry.name, "the launch file", entry.doc)
            for entry in facts.arguments.values()
            if not names_a_topic(entry) and entry.name not in _ONLY_FOR_VIEWERS
        ]
    for name, said_by, text in found:
        if name not in seen and _NAME.fullmatch(name) and ".." not in name:
            seen.add(name)
            yield name, said_by, text


def _value(name: str, names: set[str], facts: FolderFacts, examples: Mapping[str, Any]) -> tuple[Plain | None, str]:
    """The default of a parameter and where it comes from; None if nobody says it."""
    if name in examples:
        return examples[name], f"from {_EXAMPLE}"
    if facts.filled.get(name):
        return plain_value(facts.filled[name]), "from mappingtask.yaml"
    argument = facts.arguments.get(name)
    if argument is not None and argument.default is not None:
        return plain_value(argument.default), ""
    example = example_of(name, names)
    if example is not None:
        return example[0], f"from the examples of {example[1]}"
    return None, ""


def _lens_templates(name: str, folder: ForeignFolder) -> tuple[str, ...]:
    """Values of ``cam0_calib``, by which the published VINS choose ``template_cam0_pinhole.yaml`` and the like.

    Raises InvalidInput if other cameras have such templates and this one has none.
    """
    camera = name.removesuffix("_calib")
    if camera == name:
        return ()
    templates = sorted(file.removeprefix("template_") for file in folder.scripts if file.startswith("template_"))
    found = tuple(file for file in templates if file.startswith(f"{camera}_"))
    if not found and "template_" in folder.scripts.get(MAPPING, ""):
        raise InvalidInput(
            f"the parameter {name} chooses a file template_{camera}_NAME.yaml, but {folder.path / SCRIPTS} holds none",
            "add the file",
        )
    return found


_LICENCES = (
    ("GNU AFFERO GENERAL PUBLIC LICENSE", "AGPL-3.0-or-later"),
    ("GNU LESSER GENERAL PUBLIC LICENSE", "LGPL-3.0-or-later"),
    ("GNU GENERAL PUBLIC LICENSE", "GPL-3.0-or-later"),
    ("Apache License", "Apache-2.0"),
    ("MIT License", "MIT"),
    ("BSD 3-Clause", "BSD-3-Clause"),
    ("Redistribution and use in source and binary forms", "BSD"),
)
_HEAD_CHARACTERS = 1500
_OLD_GPL = re.compile(r"Version 2\b")


@dataclass(frozen=True, slots=True)
class PackageDraft:
    """A drafted ``algorithm.yaml``.

    Attributes:
        text: The file.
        unknown: What could not be known, in words.
        notes: What the user should know or check, in words.
    """

    text: str
    unknown: tuple[str, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class DraftRequest:
    """Knowledge of an import besides the folder.

    Attributes:
        name: The name of the package.
        origin: Where it comes from.
        setup: What the user says about the sensors; None to find out.
        image_user: The user that the image names; None if it is not known yet.
    """

    name: str
    origin: PackageOrigin
    setup: SensorSetup | None = None
    image_user: str | None = None


@dataclass
class _Lines:
    """The file that is being written, and what is said about it."""

    lines: list[str] = field(default_factory=list)
    unknown: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def add(self, line: str, comment: str = "") -> None:
        self.lines.append(f"{line}  # {comment}" if comment else line)

    def fact(self, key: str, value: str | None) -> None:
        """A field of the package that is either known or marked."""
        self.add(f"{key}: {_quoted(value or UNKNOWN)}", "" if value else "not known: please fill in")
        if not value:
            self.unknown.append(key)


def draft(folder: ForeignFolder, facts: FolderFacts, request: DraftRequest) -> PackageDraft:
    """Draft ``algorithm.yaml``. Raises InvalidInput if the folder does not show the sensors."""
    out = _Lines(notes=[*folder.notes])
    if facts.mapping.problem is not None:
        problem = f"{SCRIPTS}/{MAPPING} is no Python 3 ({facts.mapping.problem}), but python3 starts it"
        out.notes.append(f"{problem}; keys may be missing here")
    roles = _roles(facts, request)
    origin = request.origin
    out.add(f"# Drafted by `slamhive algorithm import` from {origin.words}.")
    out.add("# Please check it. `not known` marks what could not be found.")
    out.add("format: 1")
    out.add(f"package: {_quoted(check_name('package', request.name))}")
    out.add(f"title: {_quoted(request.name)}")
    out.add(f"version: {_quoted((origin.commit or origin.checksum or 'imported')[:19])}")
    out.fact("upstream", origin.source if "://" in origin.source else None)
    out.fact("licence", licence_of(folder.licence))
    out.fact("citation", None)
    user, reason = choose_user(facts, folder, request.image_user)
    out.add(f"user: {user.value}", _comment(reason))
    if user is not RunUser.WORKER:
        out.notes.append(f"runs are {user.in_words}: {reason}")
    if facts.ros:
        out.add(f"base: {Base.ROS1.value}", "it starts programs of ROS 1, so it is played in real time")
        out.notes.append("it plays the recording with ROS 1: in real time only, and ROS 1 bags only")
    out.add("imported:")
    for key, value in origin.content.items():
        out.add(f"  {key}: {json.dumps(value, ensure_ascii=True)}")
    _write_mode(out, facts, request, roles)
    parameters = list(draft_parameters(folder, facts, tuple(roles)))
    out.add("parameters:" if parameters else "parameters: {}")
    for entry in parameters:
        out.add(f"  {entry.key}:", entry.said_by)
        out.add(f"    type: {entry.type}")
        if entry.choices:
            out.add(f"    choices: {json.dumps(entry.choices, ensure_ascii=True)}")
        if entry.source is not None:
            out.add(f"    from: {entry.source}")
        elif entry.default is not None:
            out.add(f"    default: {json.dumps(entry.default, ensure_ascii=True)}", entry.note)
        else:
            out.add("    required: true", "not known: give a default instead, or a value with each run")
            out.unknown.append(f"default of {entry.key}")
        out.add(f"    help: {_quoted(entry.help)}")
        if entry.general is not None:
            out.add(f"    general: {entry.general}")
    return PackageDraft("\n".join(out.lines) + "\n", tuple(out.unknown), tuple(out.notes))


def _roles(facts: FolderFacts, request: DraftRequest) -> dict[str, SensorKind]:
    """The roles of the mode, as the user says, else by the topics, else by the name of the folder."""
    setup = request.setup or setup_of_roles(dict(facts.kinds)) or setup_of_name(request.name)
    if setup is None:
        found = ", ".join(f"{role} ({kind})" for role, kind in facts.kinds.items()) or "none"
        raise InvalidInput(
            f"the files of {request.name} do not show its sensors (found: {found})",
            f"say them: --setup {'|'.join(SETUPS)}",
        )
    return dict(SETUPS[setup])


def _write_mode(out: _Lines, facts: FolderFacts, request: DraftRequest, roles: dict[str, SensorKind]) -> None:
    setup = setup_of_roles(roles)
    assert setup is not None
    frame = "imu" if "imu" in roles else next(iter(roles))
    out.add("modes:")
    out.add(f"  {setup.value}:")
    out.add(f"    title: {_quoted(request.name)}")
    out.add(f"    setup: {setup.value}")
    out.add("    inputs:")
    for role, kind in roles.items():
        out.add(f"      {role}: {kind.value}")
    out.add(f"    trajectory_role: {frame}", "guessed: the sensor whose poses are in traj.txt")
    if facts.keyframes:
        out.add(f"    trajectory: {TrajectoryKind.KEYFRAMES.value}", "mapping.py takes a file of keyframes as traj.txt")
    out.notes.append(f"guessed: traj.txt holds the poses of {frame} (trajectory_role)")
    known = {role: topic for role, topic in facts.topics.items() if role in roles}
    if known:
        out.add("    topics:")
    for role, topic in known.items():
        way, name = next((way, name) for way in ("parameter", "argument", "fixed") if (name := getattr(topic, way)))
        out.add(f"      {role}: {{{way}: {_quoted(name)}}}")
        out.notes.append(f"{role}: {topic.words}")
    for role in roles:
        if role not in known:
            out.add(f"    # not known: on which topic the algorithm gets {role}; without an entry it is /{role}")
            out.unknown.append(f"topic of {role}")


def licence_of(text: str | None) -> str | None:
    """The licence whose text a file begins with; None if it is not known."""
    head = (text or "")[:_HEAD_CHARACTERS]
    for words, name in _LICENCES:
        if words.lower() in head.lower():
            return "GPL-2.0-or-later" if name.startswith("GPL") and _OLD_GPL.search(head) else name
    return None


def described(result: PackageDraft) -> Iterator[str]:
    """Remarks about a draft, one line each."""
    yield from result.notes
    if result.unknown:
        yield f"not known: {', '.join(result.unknown)}"


def _quoted(text: str) -> str:
    """Text as YAML that is also JSON."""
    return json.dumps(text, ensure_ascii=True)


def _comment(text: str) -> str:
    return " ".join(printable(text).split())
