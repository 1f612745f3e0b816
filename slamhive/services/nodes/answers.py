"""Engines are asked in threads, so that one that does not answer holds nobody up for long."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, TypeVar

from slamhive.clock import monotonic_s
from slamhive.errors import SlamHiveError, Unavailable

PATIENCE_S = 5.0
"""How long anybody waits for an engine."""
KEPT_S = 5.0
"""How long an answer is given to all who ask."""

AnswerT = TypeVar("AnswerT")


class _Question:
    """One question, asked in a thread of its own. It ends with the process if it is never answered."""

    def __init__(self, ask: Callable[[], Any]) -> None:
        self.begun_s = monotonic_s()
        self.answered_s = 0.0
        self.done = threading.Event()
        self.answer: Any = None
        self.problem: SlamHiveError | None = None
        self._ask = ask
        threading.Thread(target=self._run, name="engine", daemon=True).start()

    def _run(self) -> None:
        try:
            self.answer = self._ask()
        except SlamHiveError as error:
            self.problem = error
        except Exception as error:  # noqa: BLE001 - the executor of a plug-in can raise anything
            self.problem = Unavailable(f"the engine cannot be asked: {type(error).__name__}: {error}")
        self.answered_s = monotonic_s()
        self.done.set()


class EngineAnswers:
    """Asks each engine one question at a time, and keeps the answer for a moment. Safe to share between threads.

    Args:
        patience_s: How long to wait for an answer.
        kept_s: How long an answer is kept.
    """

    def __init__(self, patience_s: float = PATIENCE_S, kept_s: float = KEPT_S) -> None:
        self._patience_s = patience_s
        self._kept_s = kept_s
        self._lock = threading.Lock()
        self._questions: dict[str, _Question] = {}

    def of(self, name: str, ask: Callable[[], AnswerT]) -> AnswerT:
        """What ``ask`` returns or raises, asked now or a moment ago. Raises Unavailable if that takes too long."""
        with self._lock:
            question = self._questions.get(name)
            if question is None or self._is_old(question):
                question = self._questions[name] = _Question(ask)
        if not question.done.wait(max(0.0, question.begun_s + self._patience_s - monotonic_s())):
            raise Unavailable(f"{name} has not answered for {self._patience_s:g} s", "slamhive doctor examines it")
        if question.problem is not None:
            raise type(question.problem)(question.problem.message, question.problem.remedy)
        answer: AnswerT = question.answer
        return answer

    def forget(self, name: str) -> None:
        """Ask again next time: something has changed."""
        with self._lock:
            self._questions.pop(name, None)

    def _is_old(self, question: _Question) -> bool:
        return question.done.is_set() and monotonic_s() - question.answered_s >= self._kept_s
