"""Makes a Jupyter notebook of a documentation page: its Python examples become cells of code, the rest text."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator
from typing import Any

_CODE = re.compile(r"^```python\n(.*?)^```\n", re.MULTILINE | re.DOTALL)
_PAGE_LINK = re.compile(r"\]\((?=[\w-]+(?:/[\w.-]+)*\.(?:md|json))")
_RUN = re.compile(r"asyncio\.run\((\w+\(\))\)")


def notebook_of(page: str, folder: str) -> str:
    """The notebook (format 4.5) of a page in Markdown; ``folder`` leads from the notebook to the page: ``../``."""
    cells = [_cell(number, kind, text) for number, (kind, text) in enumerate(_parts(page, folder)) if text.strip()]
    content = {
        "cells": cells,
        "metadata": {
            "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
            "language_info": {"name": "python"},
        },
        "nbformat": 4,
        "nbformat_minor": 5,
    }
    return json.dumps(content, indent=1, ensure_ascii=False) + "\n"


def _parts(page: str, folder: str) -> Iterator[tuple[str, str]]:
    end = 0
    for found in _CODE.finditer(page):
        yield "markdown", _PAGE_LINK.sub(f"]({folder}", page[end : found.start()])
        # Jupyter has an event loop already, in which cells can wait.
        yield "code", _RUN.sub(r"await \1", found[1])
        end = found.end()
    yield "markdown", _PAGE_LINK.sub(f"]({folder}", page[end:])


def _cell(number: int, kind: str, text: str) -> dict[str, Any]:
    lines = text.strip("\n").splitlines(keepends=True)
    name = hashlib.sha256(f"{number} {text}".encode()).hexdigest()[:12]
    cell: dict[str, Any] = {"cell_type": kind, "id": name, "metadata": {}, "source": lines}
    return cell if kind == "markdown" else {**cell, "execution_count": None, "outputs": []}
