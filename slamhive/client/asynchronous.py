"""A server, asked from asyncio: the requests of the client, sent by another driver."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Mapping, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self, TypeVar

from slamhive.client import requests
from slamhive.client.backend import RunQuery
from slamhive.client.http import (
    CONNECTING_AGAIN,
    answer_of,
    certificates,
    connection_options,
    load_httpx,
    message_of,
    silent,
)
from slamhive.client.requests import Request
from slamhive.client.runs import submission_of
from slamhive.client.waiting import PAUSE_S, is_complete, rests
from slamhive.documents.plain import ExperimentStatusDocument

if TYPE_CHECKING:
    import httpx

    from slamhive.client.trajectory import RunTrajectory
    from slamhive.documents.run import RunDocument, RunWith
    from slamhive.domain.parameters import Value

T = TypeVar("T")


class AsyncHive:
    """A server, for programs with asyncio. Answers are the documents of the web API.

    Args:
        url: Its address, such as ``http://127.0.0.1:5000``.
        token: An API token; None for a server without accounts.
    """

    def __init__(self, url: str, token: str | None = None) -> None:
        self._url = url
        library = load_httpx()
        self._failures: tuple[type[Exception], ...] = (library.HTTPError, library.InvalidURL)
        transport = library.AsyncHTTPTransport(verify=certificates(), retries=CONNECTING_AGAIN)
        self._client: httpx.AsyncClient = library.AsyncClient(transport=transport, **connection_options(url, token))

    async def ask(self, request: Request[T]) -> T:
        """The answer to a request of :mod:`slamhive.client.requests`."""
        try:
            response = await self._client.request(**message_of(request))
        except self._failures as error:
            raise silent(self._url, error) from None
        return answer_of(request, response)

    async def runs(self, where: str = "", sort: str = "id", *, descending: bool = True) -> AsyncIterator[RunDocument]:
        """All runs that match a filter, read in pages."""
        after: str | None = None
        while True:
            page = await self.ask(requests.run_page(RunQuery(where, sort, descending), after))
            for run in page.runs:
                yield run
            after = requests.cursor(page.next)
            if after is None:
                return

    async def run(self, run_id: int) -> RunWith:
        """One run; raises NotFound."""
        return await self.ask(requests.run(run_id))

    async def file(self, run_id: int, key: str = "traj.txt") -> bytes:
        """One file of a run; raises NotFound."""
        return await self.ask(requests.run_file(run_id, key))

    async def trajectory(self, run_id: int) -> RunTrajectory:
        """The estimated trajectory of a run; raises NotFound."""
        from slamhive.client.trajectory import RunTrajectory  # noqa: PLC0415 - loads NumPy

        return RunTrajectory.of_tum(await self.file(run_id), f"run {run_id}")

    async def submit(
        self, algorithm: str, dataset: str, parameters: Mapping[str, Value] | None = None, **options: Any
    ) -> tuple[RunDocument, ...]:
        """Queue runs, as :meth:`slamhive.client.Runs.submit`."""
        asked = submission_of(algorithm, dataset, parameters, options)
        return (await self.ask(requests.submit(asked))).runs

    async def wait(self, run_ids: Sequence[int]) -> tuple[RunWith, ...]:
        """Wait until runs have ended and been evaluated; returns them."""
        found = []
        for run_id in run_ids:
            while not is_complete(run := await self.run(run_id)):
                await asyncio.sleep(PAUSE_S)
            found.append(run)
        return tuple(found)

    async def start(self, text: str, executor: str | None = None) -> ExperimentStatusDocument:
        """Queue all runs of an experiment file; the same text again completes an interrupted start."""
        return await self.ask(requests.start(text, executor))

    async def wait_for_experiment(self, name: str) -> ExperimentStatusDocument:
        """Wait until all runs of an experiment have ended and been evaluated, or until it is paused."""
        while not rests(status := await self.ask(requests.experiment(name))):
            await asyncio.sleep(PAUSE_S)
        return status

    async def close(self) -> None:
        """Close the connections."""
        await self._client.aclose()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()
