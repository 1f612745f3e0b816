"""The picture of the packages: drawn from the list of arrows in ``docs/design.md``, and compared with the imports.

``architecture.py`` prints the arrows that the imports make; a test holds the page to them.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path

import grimp

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "design.md"
Arrows = Mapping[str, frozenset[str]]
"""{package: the packages that it imports}, without those that it reaches through another one of them."""

_BLOCK = re.compile(r"```arrows\n(.*?)```", re.DOTALL)
_BOX = (118, 34)
_GAP = (14, 50)


def imported_packages() -> dict[str, set[str]]:
    """{package: the packages that its modules import} of the packages directly below ``slamhive``.

    Imports for type checkers and inside functions count: they are dependencies too.
    """
    graph = grimp.build_graph("slamhive", cache_dir=None)
    packages = {module for module in graph.find_children("slamhive") if graph.find_children(module)}
    for package in packages:
        graph.squash_module(package)
    found = {package: graph.find_modules_directly_imported_by(package) & packages - {package} for package in packages}
    return {_last(package): {_last(other) for other in others} for package, others in found.items()}


def shortest(imports: Mapping[str, set[str]]) -> dict[str, frozenset[str]]:
    """The transitive reduction: an arrow stays if no other path leads to its end.

    Raises ValueError where packages import each other in a circle.
    """
    reached: dict[str, set[str]] = {}

    def reach(name: str, above: tuple[str, ...]) -> set[str]:
        if name in above:
            raise ValueError(f"circle: {' -> '.join((*above, name))}")
        if name not in reached:
            below = [{other} | reach(other, (*above, name)) for other in imports[name]]
            reached[name] = set().union(*below)
        return reached[name]

    for name in imports:
        reach(name, ())
    return {
        name: frozenset(other for other in others if not any(other in reached[third] for third in others - {other}))
        for name, others in imports.items()
    }


def arrows_of(page: str) -> dict[str, frozenset[str]]:
    """The arrows that the page lists, one package a line: ``web -> services filters``."""
    block = _BLOCK.search(page)
    if block is None:
        raise ValueError("the page has no block of arrows")
    lines = (line.partition("->") for line in block[1].splitlines() if line.strip())
    return {name.strip(): frozenset(others.split()) for name, _, others in lines}


def as_text(arrows: Arrows) -> str:
    """The arrows as the page lists them, the outermost packages first."""
    rows = [name for row in _rows(arrows) for name in row]
    width = max(map(len, rows))
    ordered = {name: " ".join(sorted(arrows[name], key=rows.index)) for name in rows}
    return "".join(f"{name:<{width}} -> {others}".rstrip() + "\n" for name, others in ordered.items())


def as_svg(arrows: Arrows) -> str:
    """The arrows as a picture: each package stands above all that it imports."""
    rows = _rows(arrows)
    widest = max(map(len, rows))
    width = widest * (_BOX[0] + _GAP[0]) + _GAP[0]
    height = len(rows) * (_BOX[1] + _GAP[1]) - _GAP[1] + 20
    corner: dict[str, tuple[float, float]] = {}
    for line, row in enumerate(rows):
        free = width - len(row) * _BOX[0]
        for place, name in enumerate(row):
            corner[name] = (
                free / (len(row) + 1) * (place + 1) + place * _BOX[0],
                10 + line * (_BOX[1] + _GAP[1]),
            )
    parts = [
        (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img"'
            ' font-family="system-ui, sans-serif" font-size="14">'
        ),
        f'<rect width="{width}" height="{height}" fill="#ffffff"/>',
        "<title>Packages of SLAM Hive; an arrow means: imports</title>",
        (
            '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
            '<path d="M0 0 8 4 0 8z" fill="#7a8794"/></marker></defs>'
        ),
    ]
    for name, others in sorted(arrows.items()):
        left, top = corner[name]
        for other in sorted(others):
            end, below = corner[other]
            parts.append(
                f'<path d="M{left + _BOX[0] / 2:.0f} {top + _BOX[1]:.0f} C{left + _BOX[0] / 2:.0f} {top + 70:.0f}'
                f' {end + _BOX[0] / 2:.0f} {below - 36:.0f} {end + _BOX[0] / 2:.0f} {below - 2:.0f}"'
                ' fill="none" stroke="#7a8794" stroke-width="1.2" marker-end="url(#tip)"/>'
            )
    for name, (left, top) in sorted(corner.items()):
        parts += [
            (
                f'<rect x="{left:.0f}" y="{top:.0f}" width="{_BOX[0]}" height="{_BOX[1]}" rx="6" fill="#eaf1fb"'
                ' stroke="#2f6fbf"/>'
            ),
            f'<text x="{left + _BOX[0] / 2:.0f}" y="{top + 22:.0f}" text-anchor="middle" fill="#14263d">{name}</text>',
        ]
    return "\n".join([*parts, "</svg>", ""])


def _last(module: str) -> str:
    return module.rpartition(".")[2]


def _rows(arrows: Arrows) -> list[list[str]]:
    """The packages in rows: one below all that import it, as near to them as possible."""
    depth: dict[str, int] = defaultdict(int)
    for _ in arrows:  # the longest chain has no more steps than there are packages
        for name, others in arrows.items():
            for other in others:
                depth[other] = max(depth[other], depth[name] + 1)
    rows: list[list[str]] = [[] for _ in range(max(depth[name] for name in arrows) + 1)]
    where: dict[str, float] = {}
    for level, row in enumerate(rows):
        # Each package stands below the middle of those that import it, so that few arrows cross.
        row += [name for name in arrows if depth[name] == level]
        above = {name: [where[other] for other, others in arrows.items() if name in others] for name in row}
        row.sort(key=lambda name: (sum(above[name]) / max(len(above[name]), 1), name))
        where.update({name: (place + 1) / (len(row) + 1) for place, name in enumerate(row)})
    return rows


if __name__ == "__main__":
    print(as_text(shortest(imported_packages())), end="")
