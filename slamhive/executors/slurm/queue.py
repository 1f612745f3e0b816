"""Slurm as a worker's threads share it: one look at the jobs for all who ask, one ``sbatch`` for all who submit."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future

from slamhive.clock import monotonic_s
from slamhive.executors.base import StartFailed
from slamhive.executors.slurm import command
from slamhive.executors.slurm.arrays import JobRequest, Submission, chunks, submission

logger = logging.getLogger(__name__)


class Queue:
    """The jobs that Slurm knows, and the way to further ones. Safe to share between threads.

    Args:
        read: Lists the jobs.
        send: Submits a job or an array.
    """

    def __init__(
        self,
        read: Callable[[], list[command.Job]] = command.list_jobs,
        send: Callable[[Submission], None] = command.submit,
    ) -> None:
        self._read, self._send = read, send
        self._reading, self._sending, self._noting = threading.Lock(), threading.Lock(), threading.Lock()
        self._jobs: list[command.Job] = []
        self._read_at_s: float | None = None
        self._waiting: list[tuple[JobRequest, Future[None]]] = []

    def jobs(self, age_s: float) -> list[command.Job]:
        """The jobs as they were at most ``age_s`` ago. Whoever waits for the look of another thread takes the next."""
        oldest_s = monotonic_s() - age_s
        with self._reading:
            if self._read_at_s is None or self._read_at_s < oldest_s:
                begun_s = monotonic_s()
                self._jobs = self._read()
                self._read_at_s = begun_s
            return self._jobs

    def forget(self) -> None:
        """Mark what was read as out of date."""
        with self._reading:
            self._read_at_s = None

    def submit(self, request: JobRequest) -> None:
        """Return when Slurm has the job. What is asked for while another ``sbatch`` works goes out in an array.

        So nobody waits for company, and a slow Slurm is asked less often. Raises what :func:`command.submit` raises.
        """
        answer: Future[None] = Future()
        with self._noting:
            self._waiting.append((request, answer))
        with self._sending:
            if not answer.done():
                self._send_waiting()
        self.forget()
        answer.result()

    def _send_waiting(self) -> None:
        with self._noting:
            waiting, self._waiting = self._waiting, []
        answers = {id(request): answer for request, answer in waiting}
        for chunk in chunks(request for request, _ in waiting):
            self._send_chunk(chunk, [answers[id(request)] for request in chunk])

    def _send_chunk(self, requests: Sequence[JobRequest], answers: Sequence[Future[None]]) -> None:
        try:
            self._send(submission(requests))
        except StartFailed as error:
            if len(requests) > 1:
                # Arrays may be switched off, or too many for a limit that lets some of the jobs through.
                logger.info("Slurm takes no array of %d jobs: %s", len(requests), error.message)
                for request, answer in zip(requests, answers, strict=True):
                    self._send_chunk([request], [answer])
                return
            answers[0].set_exception(error)
        except Exception as error:  # noqa: BLE001 - it is raised where the answer is awaited
            for answer in answers:
                answer.set_exception(error)
        else:
            for answer in answers:
                answer.set_result(None)
