"""Recordings that a library in an environment of its own reads: the process, and the stream that it writes.

Such a library brings hundreds of MB, pins packages that SLAM Hive needs in other versions, or ends its whole process
when a file is damaged. Data comes through a pipe, one message at a time, from ``outside_reader.py``.
"""

from __future__ import annotations

import io
import math
import os
import re
import select
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import IO, Any, Literal, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, NonNegativeInt

from slamhive.base.errors import InvalidInput, Unavailable
from slamhive.domain.names import printable
from slamhive.domain.question import time_words
from slamhive.recordings.geometry import Array
from slamhive.recordings.importers.outside_reader import ALIVE, RECORD_HEADER
from slamhive.recordings.writers import NS_PER_S

_READER = Path(__file__).with_name("outside_reader.py")
_MOST_RECORD_BYTES = 128_000_000
_MOST_ARRAY_BYTES = 200_000_000
_MOST_LINE_BYTES = 1_000_000
_MOST_NS = 2**31 * NS_PER_S
_SHOWN = 300
_MOST_WORDS_BYTES = 64_000
_MOST_SILENCE_S = 600.0
"""A reader that writes nothing for so long hangs. It writes signs of life while it reads; opening is silent."""
_COLOURS = re.compile(r"\x1b\[[0-9;]*m")


@dataclass(frozen=True, slots=True)
class Library:
    """A library that reads recordings: its name in commands and messages, its module, and what pip calls it."""

    name: str
    module: str
    package: str

    @property
    def variable(self) -> str:
        """The environment variable that names an interpreter with the library."""
        return f"SLAMHIVE_{self.name.upper()}_PYTHON"

    def python(self) -> Path:
        """The interpreter that has the library; raises Unavailable if none is known."""
        named = os.environ.get(self.variable)
        if named:
            if not Path(named).is_file():
                raise Unavailable(f"{self.variable} names {named}, which does not exist", "correct the variable")
            return Path(named)
        if find_spec(self.module) is not None:
            return Path(sys.executable)
        raise Unavailable(
            f"no environment with {self.package} is known",
            f"make one (python3 -m venv {self.name} && {self.name}/bin/pip install {self.package}), "
            f"and set {self.variable} to its python",
        )


class OutsidePlan(BaseModel):
    """Answer of the reader about a recording. ``values`` are the arrays, by name.

    An array ``imu`` has a row for each time of ``imu_times_ns``.
    """

    model_config = ConfigDict(arbitrary_types_allowed=True)
    arrays: list[tuple[str, Literal["<i8", "<f8"], tuple[NonNegativeInt, ...]]]
    values: dict[str, Any] = Field(default_factory=dict, exclude=True)

    @property
    def columns(self) -> dict[str, int]:
        """The arrays that the answer must have, and their columns."""
        raise NotImplementedError

    @property
    def complete(self) -> bool:
        """All arrays are there, with their columns, and a row for each time."""
        if any(values.ndim not in (1, 2) for values in self.values.values()):
            return False
        columns = {name: 1 if values.ndim == 1 else values.shape[-1] for name, values in self.values.items()}
        return columns == self.columns and all(
            len(values) == len(self.values.get(f"{name}_times_ns", values)) for name, values in self.values.items()
        )


PlanType = TypeVar("PlanType", bound=OutsidePlan)


@dataclass(frozen=True, slots=True)
class OutsideRecording:
    """A recording that ``library`` reads from ``path``; ``name`` is what messages call it."""

    library: Library
    path: Path
    name: str

    def plan(self, kind: type[PlanType], part: str = "") -> PlanType:
        """The recording without its large messages; reads all of it once.

        Raises:
            Unavailable: There is no environment with the library.
            InvalidInput: The library cannot read the recording, with its reason.
        """
        with self._reading("plan", part) as stream:
            try:
                while (line := stream.readline(_MOST_LINE_BYTES)) == ALIVE["plan"]:
                    pass
                about = kind.model_validate_json(line)
                for name, code, shape in about.arrays:
                    dtype = np.dtype(code)
                    size = math.prod(shape) * dtype.itemsize
                    data = stream.read(size) if size <= _MOST_ARRAY_BYTES else b""
                    if len(data) < size:
                        raise self._broken()
                    about.values[name] = np.frombuffer(data, dtype=dtype).reshape(shape)
            except ValueError:
                raise self._broken() from None
            if not about.complete:
                raise self._broken()
        return about

    def records(self, part: str, dtype: Any) -> Iterator[tuple[int, Array]]:
        """Time in ns and content of each message of ``part``, an array of ``dtype``."""
        item = np.dtype(dtype)
        with self._reading("records", part) as stream:
            while header := stream.read(RECORD_HEADER.size):
                if len(header) < RECORD_HEADER.size:
                    raise self._broken()
                if header == ALIVE["records"]:
                    continue
                time_ns, count = RECORD_HEADER.unpack(header)
                size = count * item.itemsize
                if size > _MOST_RECORD_BYTES:
                    raise InvalidInput(
                        f"a message of {self.name} has {size} bytes", f"at most {_MOST_RECORD_BYTES} are read"
                    )
                data = stream.read(size)
                if len(data) < size:
                    raise self._broken()
                content: Array = np.frombuffer(data, dtype=item)
                yield time_ns, content

    def check_order(self, what: str, times_ns: Array) -> None:
        """Raise InvalidInput unless the timestamps of ``what`` increase, and a recording can hold them."""
        if len(times_ns) and (times_ns[0] < 0 or times_ns[-1] >= _MOST_NS or (np.diff(times_ns) <= 0).any()):
            raise InvalidInput(
                f"the timestamps of the {what} of {self.name} do not increase, or are out of range",
                "correct the recording",
            )

    @contextmanager
    def _reading(self, mode: str, part: str) -> Iterator[IO[bytes]]:
        """The output of the reader, which ends with the block; its last words are the error if it fails."""
        # -P: modules beside the reader may have the name of a library, and must not come first.
        command = [str(self.library.python()), "-P", str(_READER), self.library.name, mode, str(self.path), part]
        code = 0
        with tempfile.TemporaryFile() as words:
            process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=words, bufsize=0
            )
            assert process.stdout is not None
            silence = InvalidInput(
                f"{self.library.name} hangs while it reads {self.name}: it gave nothing for "
                f"{time_words(_MOST_SILENCE_S)}, and was ended",
                self._remedy,
            )
            stream = io.BufferedReader(_WatchedPipe(process.stdout, silence))
            try:
                yield stream
                code = _code_at_end(process, stream, silence)
            except InvalidInput as error:
                # A stream that breaks off is no reason where its writer has one.
                code = 0 if error is silence else _code_at_end(process, stream, silence)
                if not code:
                    raise
            finally:
                stream.close()
                process.kill()
                process.wait()
            if code:
                words.seek(max(0, words.seek(0, os.SEEK_END) - _MOST_WORDS_BYTES))
                text = _COLOURS.sub("", words.read().decode(errors="replace"))
                # The library may quote the recording, which is from outside: no command may reach a terminal.
                said = (printable(line).strip() for line in text.splitlines())
                lines = [line for line in said if line] or ["it gave no reason"]
                known = code < 0 and -code in set(signal.Signals)
                ended = f" (ended by {signal.Signals(-code).name if known else f'signal {-code}'})" if code < 0 else ""
                raise InvalidInput(
                    f"{self.library.name} cannot read {self.name}: {lines[-1][:_SHOWN]}{ended}",
                    self._remedy,
                )

    @property
    def _remedy(self) -> str:
        return f"see whether {self.library.name} itself can read the recording"

    def _broken(self) -> InvalidInput:
        return InvalidInput(f"{self.library.name} stopped while it read {self.name}", self._remedy)


class _WatchedPipe(io.RawIOBase):
    """The output of a process, which raises ``silence`` where nothing comes for :data:`_MOST_SILENCE_S`."""

    def __init__(self, pipe: IO[bytes], silence: InvalidInput) -> None:
        self._pipe = pipe
        self._silence = silence
        self._poll = select.poll()
        self._poll.register(pipe, select.POLLIN)

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        if not self._poll.poll(_MOST_SILENCE_S * 1000):
            raise self._silence
        return os.readv(self._pipe.fileno(), [buffer])

    def close(self) -> None:
        self._pipe.close()
        super().close()


def _code_at_end(process: subprocess.Popen[bytes], stream: IO[bytes], silence: InvalidInput) -> int:
    """The exit code of a process that has written everything, 0 of one that goes on; raises ``silence``."""
    try:
        return 0 if stream.read(1) else process.wait(_MOST_SILENCE_S)
    except subprocess.TimeoutExpired:
        raise silence from None
