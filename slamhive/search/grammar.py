"""``and``, ``or``, ``not`` and brackets over comparisons of any kind."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Generic, TypeAlias, TypeVar

Leaf = TypeVar("Leaf")
Other = TypeVar("Other")


@dataclass(frozen=True, slots=True)
class Junction(Generic[Leaf]):
    """``and``, ``or`` over two or more parts, ``not`` over one. Parts of the same word are joined, not nested."""

    word: str
    parts: tuple[Junction[Leaf] | Leaf, ...]


Tree: TypeAlias = Junction[Leaf] | Leaf


def join(word: str, parts: list[Tree[Leaf]]) -> Tree[Leaf]:
    """Join parts by ``and`` or ``or``; a single part stays alone."""
    flat: list[Tree[Leaf]] = []
    for part in parts:
        flat.extend(part.parts if isinstance(part, Junction) and part.word == word else [part])
    return flat[0] if len(flat) == 1 else Junction(word, tuple(flat))


def leaves(tree: Tree[Leaf]) -> Iterator[Leaf]:
    """Every comparison, from left to right."""
    if isinstance(tree, Junction):
        for part in tree.parts:
            yield from leaves(part)
    else:
        yield tree


def mapped(tree: Tree[Leaf], change: Callable[[Leaf], Other]) -> Tree[Other]:
    """The same tree with each comparison replaced by ``change`` of it."""
    if isinstance(tree, Junction):
        return Junction(tree.word, tuple(mapped(part, change) for part in tree.parts))
    return change(tree)


def written(tree: Tree[Leaf], leaf: Callable[[Leaf], str], outer: str = "") -> str:
    """The tree as text, with brackets where they are needed."""
    if not isinstance(tree, Junction):
        return leaf(tree)
    if tree.word == "not":
        (part,) = tree.parts
        inner = written(part, leaf, "not")
        return f"not ({inner})" if isinstance(part, Junction) else f"not {inner}"
    text = f" {tree.word} ".join(written(part, leaf, tree.word) for part in tree.parts)
    return f"({text})" if tree.word == "or" and outer == "and" else text
