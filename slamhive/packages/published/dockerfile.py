"""Users, folders and needed files of a Dockerfile. Nothing is built here."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

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
