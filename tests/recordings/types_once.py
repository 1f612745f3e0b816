"""Reads each definition of a message once, and compiles what reads such messages once, for all recordings of a process.

rosbags does both anew for each recording that is opened, which took a third of the time of tests of recordings.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from types import ModuleType
from unittest import mock

from rosbags.highlevel import anyreader
from rosbags.serde import cdr, ros1
from rosbags.serde.utils import compile_lines
from rosbags.typesys import get_types_from_msg

_compiled: dict[str, ModuleType] = {}
_types_from_msg = cache(get_types_from_msg)


@contextmanager
def types_read_once() -> Iterator[None]:
    """Meanwhile, equal text is not read or compiled again. What comes of it holds nothing of the recording."""
    patches: list[tuple[ModuleType, str, Callable[..., object]]] = [
        (anyreader, "get_types_from_msg", lambda text, name: dict(_types_from_msg(text, name))),
        (cdr, "compile_lines", _compile_once),
        (ros1, "compile_lines", _compile_once),
    ]
    with ExitStack() as stack:
        for module, name, replacement in patches:
            stack.enter_context(mock.patch.object(module, name, replacement))
        yield


def _compile_once(lines: list[str]) -> ModuleType:
    text = "\n".join(lines)
    if text not in _compiled:
        _compiled[text] = compile_lines(lines)
    return _compiled[text]
