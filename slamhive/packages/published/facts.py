"""Evidence in a folder and its Dockerfile about the sensors, topics, values and user of its algorithm."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from slamhive.base.errors import InvalidInput
from slamhive.domain.algorithm import RunUser
from slamhive.domain.roles import TopicOf
from slamhive.domain.sensors import SensorKind, SensorSetup
from slamhive.packages.published.folder import DOCKERFILE, MAPPING, SCRIPTS, ForeignFolder
from slamhive.packages.published.script import (
    LaunchArgument,
    LaunchFile,
    PackageScript,
    Placeholder,
    filled_values,
    fixed_values,
    read_launch,
    read_placeholders,
    read_script,
)

_HOME = re.compile(r"(?:^|[\s\"'=:;(])((?:/root|/home|~/|\$HOME|\$\{HOME\})[\w./-]*)")
_INSTRUCTION = re.compile(r"^\s*([A-Za-z]+)\s+(.*)$", re.DOTALL)
_SUBMODULE = re.compile(r"^\s*path\s*=\s*(\S.*?)\s*$", re.MULTILINE)
_ROOT = frozenset({"", "0", "root"})
_FEWEST = 2


@dataclass(frozen=True, slots=True)
class Instruction:
    """One instruction: its line, its word in upper case, and what follows."""

    line: int
    word: str
    rest: str


@dataclass(frozen=True, slots=True)
class DockerfileFacts:
    """The relevant content of a Dockerfile.

    Attributes:
        base: The image of the last stage.
        user: The last ``USER`` of the last stage; empty for root.
        homes: Folders of users that the last stage works in, each with the line that names it.
        missing: Sources of ``COPY`` and ``ADD`` that the folder lacks, each with its line.
        empty: Folders that they copy and that hold nothing, because Git keeps a link to another repository there.
    """

    base: str
    user: str
    homes: tuple[tuple[str, int], ...]
    missing: tuple[tuple[str, int], ...]
    empty: tuple[tuple[str, int], ...] = ()


def read_dockerfile(text: str, folder: Path) -> DockerfileFacts:
    """Read the Dockerfile of ``folder``."""
    instructions: list[Instruction] = []
    pieces: list[str] = []
    first = 1
    for number, line in enumerate(text.splitlines(), start=1):
        if line.lstrip().startswith("#"):
            continue
        first = first if pieces else number
        goes_on = line.rstrip().endswith("\\")
        pieces.append(line.rstrip().removesuffix("\\"))
        if goes_on:
            continue
        match = _INSTRUCTION.match("\n".join(pieces))
        pieces = []
        if match:
            instructions.append(Instruction(first, match[1].upper(), match[2].strip()))
    starts = [index for index, entry in enumerate(instructions) if entry.word == "FROM"]
    last = instructions[starts[-1] :] if starts else []
    users = [entry.rest.split()[0].partition(":")[0] for entry in last if entry.word == "USER" and entry.rest.split()]
    homes = {name: entry.line for entry in reversed(last) for name in homes_in(entry.rest)}
    missing = [(source, entry.line) for entry in instructions for source in _sources(entry) if _lacks(folder, source)]
    # Submodules of Git that were not fetched: downloads, and clones of one level, lack them.
    root = folder.resolve()
    links: list[PurePosixPath] = []
    for repository in (root, *root.parents):
        try:
            text = (repository / ".gitmodules").read_text(encoding="utf-8", errors="replace")
        except OSError:
            text = ""
        places = [repository / match[1] for match in _SUBMODULE.finditer(text)]
        links += [PurePosixPath(place.relative_to(root)) for place in places if _is_empty_inside(place, root)]
        if (repository / ".git").exists():
            break
    empty = {
        place: entry.line
        for entry in reversed(instructions)
        for source in _sources(entry)
        for place in _copied_empty(folder, source, links)
    }
    return DockerfileFacts(
        base=_base(last[0].rest) if last else "",
        user="" if not users or users[-1] in _ROOT else users[-1],
        homes=tuple(sorted(homes.items(), key=lambda entry: entry[1])),
        missing=tuple(missing),
        empty=tuple(sorted(empty.items(), key=lambda entry: entry[1])),
    )


def homes_in(text: str) -> list[str]:
    """The folders of users that a text names: ``/root/.ros``, ``/home/ubuntu/ws``, ``~/ws``."""
    return list(dict.fromkeys(found[1] for found in _HOME.finditer(text)))


def _base(rest: str) -> str:
    words = [word for word in rest.split() if not word.startswith("--")]
    return words[0] if words else ""


def _sources(entry: Instruction) -> list[str]:
    """The files of the build context that an instruction copies; those with variables cannot be known."""
    if entry.word not in {"COPY", "ADD"}:
        return []
    words = entry.rest.split()
    if any(word.startswith("--from") for word in words):
        return []
    words = [word for word in words if not word.startswith("--")]
    if words and words[0].startswith("["):
        words = _json_words(" ".join(words))
    if len(words) < _FEWEST:
        return []
    return [word for word in words[:-1] if "$" not in word and "://" not in word and not word.startswith("<<")]


def _json_words(text: str) -> list[str]:
    try:
        words = json.loads(text)
    except (ValueError, RecursionError):
        return []
    return [word for word in words if isinstance(word, str)] if isinstance(words, list) else []


def _is_empty_inside(place: Path, root: Path) -> bool:
    """Return whether ``place`` is a folder below ``root`` without any file."""
    if ".." in place.parts or not place.is_relative_to(root):
        return False
    try:
        return place.is_dir() and not any(path.is_file() or path.is_symlink() for path in place.rglob("*"))
    except (OSError, ValueError):
        return False


def _copied_empty(folder: Path, source: str, links: list[PurePosixPath]) -> list[str]:
    """The folders without content that an instruction copies with ``source``, as paths below ``folder``."""
    if _lacks(folder, source) or any(mark in source for mark in "*?["):
        return []
    place = PurePosixPath(source.lstrip("/") or ".")
    inside = [str(link) for link in links if link.is_relative_to(place)]
    # Git holds no empty folders: one that is copied by its name was a link, listed or not.
    if not inside and place.parts and _is_empty_inside(folder.resolve() / place, folder.resolve()):
        return [str(place)]
    return inside


def _lacks(folder: Path, source: str) -> bool:
    """Tell if the build context lacks ``source``; what points out of the context is lacking too."""
    place = PurePosixPath(source.lstrip("/") or ".")
    if ".." in place.parts:
        return True
    try:
        if "**" in source:
            return False
        if any(mark in source for mark in "*?["):
            return next(iter(folder.glob(str(place))), None) is None
        return not (folder / place).exists()
    except (OSError, ValueError, NotImplementedError, IndexError):
        return True


# Evidence in a folder about the sensors, topics, values and user of its algorithm.


# Which sensor a topic or its name means, by the words in it.


Role = tuple[str, SensorKind]

_WORDS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")
_NO_SENSOR = frozenset({"odom", "odometry", "path", "map", "gps", "gnss", "pose", "output", "tf", "cmd"})
_ROLES: tuple[tuple[Role, frozenset[str]], ...] = (
    (("imu", SensorKind.IMU), frozenset({"imu"})),
    (("depth", SensorKind.DEPTH), frozenset({"depth", "dep"})),
    (("points", SensorKind.LIDAR), frozenset({"points", "pointcloud", "cloud", "velodyne", "lidar", "pointclouds"})),
    (("scan", SensorKind.LASER), frozenset({"scan", "laserscan"})),
    (("right", SensorKind.CAMERA), frozenset({"right", "image1", "cam1", "img1", "camera1"})),
    (
        ("left", SensorKind.CAMERA),
        frozenset(
            {
                "left",
                "image0",
                "cam0",
                "img0",
                "camera0",
                "image",
                "img",
                "cam",
                "camera",
                "rgb",
                "mono",
                "color",
                "colour",
            }
        ),
    ),
)
_TOPIC = re.compile(r"/?[A-Za-z]\w*(?:/\w+){0,8}")
_FOLDERS = ("/home/", "/root/", "/slamhive/", "/opt/", "/usr/", "/tmp/", "/media/", "/data/", "/mnt/")  # noqa: S108

SETUPS: dict[SensorSetup, tuple[Role, ...]] = {
    SensorSetup.MONO: (("left", SensorKind.CAMERA),),
    SensorSetup.STEREO: (("left", SensorKind.CAMERA), ("right", SensorKind.CAMERA)),
    SensorSetup.RGBD: (("left", SensorKind.CAMERA), ("depth", SensorKind.DEPTH)),
    SensorSetup.MONO_INERTIAL: (("left", SensorKind.CAMERA), ("imu", SensorKind.IMU)),
    SensorSetup.STEREO_INERTIAL: (("left", SensorKind.CAMERA), ("right", SensorKind.CAMERA), ("imu", SensorKind.IMU)),
    SensorSetup.LIDAR: (("points", SensorKind.LIDAR),),
    SensorSetup.LIDAR_INERTIAL: (("points", SensorKind.LIDAR), ("imu", SensorKind.IMU)),
}
_LIDAR_NAMES = frozenset({"loam", "aloam", "lidar", "velodyne", "laser", "ndt", "icp", "lio"})


def words_in(text: str) -> set[str]:
    """The words of a name in lower case, numbers joined to what stands before: ``image0_topic`` has ``image0``."""
    parts = [part.lower() for part in _WORDS.findall(text)]
    joined = {first + second for first, second in itertools.pairwise(parts) if second.isdigit()}
    return set(parts) | joined


def role_of(name: str) -> Role | None:
    """The role and kind of sensor that a name means; None if it names none, or an output."""
    words = words_in(name)
    if words & _NO_SENSOR:
        return None
    if {"point", "cloud"} <= words or {"laser", "cloud"} <= words:
        return "points", SensorKind.LIDAR
    return next((role for role, known in _ROLES if words & known), None)


def is_topic(text: str) -> bool:
    """Tell if ``text`` looks like the name of a topic, and not like a path."""
    return _TOPIC.fullmatch(text) is not None and not text.startswith(_FOLDERS)


def setup_of_name(name: str) -> SensorSetup | None:
    """The set-up that the name of a folder says: ``orb-slam3-ros-stereo-inertial``."""
    words = words_in(name)
    inertial = bool(words & {"imu", "inertial", "vio", "lio"})
    if words & _LIDAR_NAMES:
        return SensorSetup.LIDAR_INERTIAL if inertial else SensorSetup.LIDAR
    if "rgbd" in words or {"rgb", "d"} <= words:
        return SensorSetup.RGBD
    if "stereo" in words:
        return SensorSetup.STEREO_INERTIAL if inertial else SensorSetup.STEREO
    if "mono" in words:
        return SensorSetup.MONO_INERTIAL if inertial or "vins" in words else SensorSetup.MONO
    return None


def setup_of_roles(roles: dict[str, SensorKind]) -> SensorSetup | None:
    """The set-up with just these kinds of sensors; None if there is none."""
    kinds = sorted(kind.value for kind in roles.values())
    return next(
        (setup for setup, known in SETUPS.items() if sorted(kind.value for _, kind in known) == kinds),
        None,
    )


_TEMPLATE = re.compile(r"template\w*\.ya?ml")
_EXAMPLE_FILES = ("mappingtask.yaml", "mappingtask.yml")
_NAMED_FILE = re.compile(r"/slamhive/([\w.-]+\.(?:launch|py|sh|bash))")
_ROS = re.compile(r"\broslaunch\b|\brosbag\b|\broscore\b|/opt/ros/|rosbag_play\.py")
_KEYFRAMES = re.compile(r"(?:keyframe\w*\.txt|loop\.csv)\s+/slamhive/result/traj\.txt", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class FolderFacts:
    """Findings in a folder.

    Attributes:
        mapping: ``mapping.py``.
        placeholders: Of all templates, each once, with the template that it stands in.
        arguments: Of the launch files that ``mapping.py`` starts.
        topics: How the algorithm learns of the topics of its roles.
        kinds: The kind of sensor of each role that has a topic.
        filled: Values of placeholders that a filled template in the folder has.
        dockerfile: What the ``Dockerfile`` says; None without one.
        modules: What the scripts import, other than each other.
        ros: It starts programs of ROS 1.
        keyframes: ``mapping.py`` takes a file of keyframes as the trajectory.
    """

    mapping: PackageScript
    placeholders: Mapping[str, tuple[str, Placeholder]]
    arguments: Mapping[str, LaunchArgument]
    topics: Mapping[str, TopicOf]
    kinds: Mapping[str, SensorKind]
    filled: Mapping[str, str]
    dockerfile: DockerfileFacts | None
    modules: tuple[str, ...]
    ros: bool
    keyframes: bool


def find_facts(folder: ForeignFolder) -> FolderFacts:
    """Read what the files of ``folder`` say; raises InvalidInput where ``mapping.py`` and its files contradict."""
    scripts = {name: read_script(text) for name, text in folder.scripts.items() if name.endswith(".py")}
    mapping = scripts[MAPPING]
    templates = {name: text for name, text in folder.scripts.items() if _TEMPLATE.fullmatch(name)}
    named = [match[1] for text in mapping.texts for match in _NAMED_FILE.finditer(text)]
    for name in dict.fromkeys([*mapping.reads, *named]):
        if name in {"config.yaml", "config.yml"} or name.startswith(("dataset/", "result/")):
            continue
        if not (folder.path / SCRIPTS / name).exists():
            raise InvalidInput(
                f"{SCRIPTS}/{MAPPING} uses /slamhive/{name}, but {folder.path / SCRIPTS} does not hold it",
                "add the file, or correct the script",
            )
    placeholders: dict[str, tuple[str, Placeholder]] = {}
    for name, text in templates.items():
        entries, problems = read_placeholders(text)
        if problems:
            raise InvalidInput(f"{SCRIPTS}/{name} {problems[0]}", "write $$ for a dollar sign")
        for entry in entries:
            placeholders.setdefault(entry.name, (name, entry))
    # Those that mapping.py names, or all if it names none.
    files = {name: text for name, text in folder.scripts.items() if name.endswith(".launch") and "/" not in name}
    named = [name for name in files if any(name in text for text in mapping.texts)]
    launches = [read_launch(files[name]) for name in named or files]
    topics, kinds = _topics(mapping, placeholders, launches, templates.values())
    filled: dict[str, str] = {}
    for text in templates.values():
        for name in _EXAMPLE_FILES:
            filled.update(filled_values(text, folder.scripts.get(name, "")))
    known = {Path(name).stem for name in scripts}
    imported = dict.fromkeys(module for script in scripts.values() for module in script.imports)
    said = [*mapping.texts, folder.dockerfile or "", *folder.scripts.values()]
    return FolderFacts(
        mapping=mapping,
        placeholders=placeholders,
        arguments={entry.name: entry for launch in launches for entry in launch.arguments},
        topics=topics,
        kinds=kinds,
        filled=filled,
        dockerfile=None if folder.dockerfile is None else read_dockerfile(folder.dockerfile, folder.path),
        modules=tuple(module for module in imported if module not in known),
        ros=any(_ROS.search(text) for text in said),
        keyframes=any(_KEYFRAMES.search(text) for text in mapping.texts),
    )


def choose_user(facts: FolderFacts, folder: ForeignFolder, image_user: str | None = None) -> tuple[RunUser, str]:
    """The user that the runs of a folder need, and why; ``image_user`` is what the image says, where it is known."""
    user = image_user if image_user is not None else (facts.dockerfile.user if facts.dockerfile else "")
    if user not in ("", "0", "root", "0:0", "root:root"):
        return RunUser.IMAGE, f"the image has the user {user}"
    for name, text in folder.scripts.items():
        homes = homes_in(text)
        if homes:
            return RunUser.ROOT, f"{SCRIPTS}/{name} names {homes[0]}"
    if facts.dockerfile is not None and facts.dockerfile.homes:
        home, line = facts.dockerfile.homes[0]
        return RunUser.ROOT, f"{DOCKERFILE} line {line} names {home}"
    return RunUser.WORKER, "nothing names a folder of another user"


def _topics(
    mapping: PackageScript,
    placeholders: Iterable[str],
    launches: Iterable[LaunchFile],
    templates: Iterable[str],
) -> tuple[dict[str, TopicOf], dict[str, SensorKind]]:
    """The topic of each role: a parameter before a launch argument before a fixed topic."""
    topics: dict[str, TopicOf] = {}
    kinds: dict[str, SensorKind] = {}
    ways: list[Way] = [(name, {"parameter": name}) for name in placeholders if "topic" in words_in(name)]
    for launch in launches:
        arguments = launch.arguments if "algorithm-remap" in mapping.sections else ()
        ways += [(entry.name, {"argument": entry.name}) for entry in arguments if names_a_topic(entry)]
        ways += [(topic, {"fixed": f"/{topic.lstrip('/')}"}) for topic in launch.fixed_topics if is_topic(topic)]
    for key, value in (entry for text in templates for entry in fixed_values(text)):
        if "topic" in words_in(key) and is_topic(value):
            ways.append((key, {"fixed": f"/{value.lstrip('/')}"}))
    for name, way in ways:
        role = role_of(name)
        if role is not None and role[0] not in topics:
            topics[role[0]] = TopicOf(role[0], **way)
            kinds[role[0]] = role[1]
    if "points" in topics:  # LiDAR systems name topics of cameras too, which only their viewers use
        for entry in [entry for entry, kind in kinds.items() if kind is SensorKind.CAMERA]:
            del topics[entry], kinds[entry]
    return topics, kinds


Way = tuple[str, dict[str, str]]
"""A name that says which sensor is meant, and the field of :class:`TopicOf`."""


def names_a_topic(argument: LaunchArgument) -> bool:
    """Tell if a launch argument names the topic of a sensor."""
    default = argument.default or ""
    if "topic" in words_in(argument.name):
        return role_of(argument.name) is not None
    return default.startswith("/") and is_topic(default) and role_of(argument.name) is not None
