"""The entrance to the client."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Generic, Self, TypeVar

if TYPE_CHECKING:
    from slamhive.client.backend import Backend
    from slamhive.client.experiments import Analyses, Experiments
    from slamhive.client.runs import Runs
    from slamhive.documents.catalogue import AlgorithmDocument, DatasetDocument
    from slamhive.documents.challenge import ChallengeSubmission
    from slamhive.documents.claims import ClaimsAnswer
    from slamhive.documents.imports import ImportedDocument


class Hive:
    """An installation: a data root or a server. Close it, or use it in a ``with`` statement.

    One thread may use it at a time.
    """

    def __init__(self, backend: Backend) -> None:
        self._backend = backend

    @classmethod
    def open(cls, path: Path | str, *, writable: bool = False) -> Self:
        """The data root at ``path``, without a server.

        Reads only and creates nothing, unless it is ``writable``. Raises NotFound if there is no data root, and a
        SlamHiveError if it cannot be used.
        """
        from slamhive.client.local import LocalBackend  # noqa: PLC0415 - a client of a server needs no database

        return cls(LocalBackend.open(Path(path), writable=writable))

    @classmethod
    def connect(cls, url: str, *, token: str | None = None) -> Self:
        """The installation that the server at ``url`` serves, such as ``http://127.0.0.1:5000``.

        ``token`` is an API token; None for a server without accounts. Nothing is sent before something is asked for.
        Raises Unavailable if httpx is not installed.
        """
        from slamhive.client.http import HttpBackend  # noqa: PLC0415 - reading a data root needs no HTTP

        return cls(HttpBackend(url, token))

    @property
    def runs(self) -> Runs:
        """All runs."""
        from slamhive.client.runs import Runs  # noqa: PLC0415 - on first use, as everywhere in this package

        return Runs(self._backend)

    @property
    def experiments(self) -> Experiments:
        """All experiments."""
        from slamhive.client.experiments import Experiments  # noqa: PLC0415 - on first use

        return Experiments(self._backend)

    @property
    def analyses(self) -> Analyses:
        """All listed analyses."""
        from slamhive.client.experiments import Analyses  # noqa: PLC0415 - on first use

        return Analyses(self._backend)

    @property
    def datasets(self) -> Named[DatasetDocument]:
        """All datasets: their sensors, durations and ground truth (``docs/schemas/dataset.schema.json``)."""
        return Named(self._backend.datasets, self._backend.dataset)

    @property
    def algorithms(self) -> Named[AlgorithmDocument]:
        """All algorithms: what they need, and their parameters (``docs/schemas/algorithm.schema.json``)."""
        return Named(self._backend.algorithms, self._backend.algorithm)

    def import_dataset(self, path: Path | str, *, progress: bool = True, **options: Any) -> ImportedDocument:
        """Make a dataset of the recording at ``path``, a file or a folder of this machine.

        It is sent to a server in parts; a broken connection costs one part at most. ``options`` are the fields of
        :class:`~slamhive.documents.imports.RecordingFacts`; ``groundtruth`` and ``calibration`` are paths. Raises
        NotFound, InvalidInput or Conflict naming the value.
        """
        return self._backend.import_dataset(Path(path), options, progress=progress)

    def import_runs(self, path: Path | str, *, progress: bool = True, **options: Any) -> ImportedDocument:
        """Import the trajectories in the folder at ``path`` as runs; a worker evaluates them.

        ``options`` are the fields of :class:`~slamhive.documents.imports.RunsUpload`.
        """
        return self._backend.import_runs(Path(path), options, progress=progress)

    def claims(self) -> tuple[ClaimsAnswer, ...]:
        """The last answers about the claims of papers and READMEs (``docs/schemas/claims-answer.schema.json``)."""
        return self._backend.claims()

    def submit_image(
        self, challenge: str, path: Path | str | None = None, *, progress: bool = True, **options: Any
    ) -> ChallengeSubmission:
        """Submit the image at ``path`` to a challenge, or with ``package="NAME@2"`` a package of the installation.

        The file is what ``slamhive algorithm export`` or ``docker save`` wrote. ``options`` are the fields of
        :class:`~slamhive.documents.challenge.ImageEntry`. Raises NotFound, InvalidInput, Conflict or
        TooManyRequests.
        """
        return self._backend.submit_image(challenge, None if path is None else Path(path), options, progress=progress)

    def challenge_submissions(self, challenge: str) -> tuple[ChallengeSubmission, ...]:
        """One's own submissions to a challenge, the newest first; of a data root all. Raises NotFound."""
        return self._backend.challenge_submissions(challenge)

    def close(self) -> None:
        """Close the database or the connection."""
        self._backend.close()

    def __repr__(self) -> str:
        return f"<SLAM Hive {self._backend.label}>"

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


# What runs are made of: datasets and algorithms.


D = TypeVar("D")


class Named(Generic[D]):
    """The datasets, or the algorithms, of an installation in the order of their names.

    Args:
        read_all: Reads the documents of all.
        read_one: Reads the document of one name; raises NotFound.
    """

    def __init__(self, read_all: Callable[[], tuple[D, ...]], read_one: Callable[[str], D]) -> None:
        self._read_all = read_all
        self._read_one = read_one

    def __iter__(self) -> Iterator[D]:
        return iter(self._read_all())

    def get(self, name: str) -> D:
        """The document of one name; raises NotFound."""
        return self._read_one(name)
