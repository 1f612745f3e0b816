"""Doing something as a user without rights, whoever runs the tests."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from typing import Any

from slamhive.executors.process.containment_base import DoesNotHold

_NOBODY = 65_534


def as_nobody(work: Callable[[], Any]) -> Any:
    """What ``work`` returns (as JSON), or the error that it ended with, in a process of its own that is not root's."""
    reader, writer = os.pipe()
    pid = os.fork()
    if pid == 0:
        answer: Any = None
        try:
            if os.getuid() == 0:
                os.setgroups([])
                os.setgid(_NOBODY)
                os.setuid(_NOBODY)
            answer = work()
        except (DoesNotHold, OSError) as error:
            answer = repr(error)
        finally:
            os.write(writer, json.dumps(answer).encode())
            os._exit(0)
    os.close(writer)
    os.waitpid(pid, 0)
    with os.fdopen(reader) as stream:
        return json.load(stream)
