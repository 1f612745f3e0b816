"""What goes over the socket: JSON, and streams whose end carries a checksum. Who does not know the token is refused."""

from __future__ import annotations

import hashlib
import json
from multiprocessing.connection import Client, Connection
from typing import IO, Any

from slamhive.base.errors import SlamHiveError
from slamhive.executors.base import EngineUnavailable, ImageMissing, StartFailed

CHUNK_BYTES = 1 << 20
MOST_JSON_BYTES = 10_000_000
ERRORS = {kind.__name__: kind for kind in (EngineUnavailable, ImageMissing, StartFailed)}


def connect(address: str, token: str) -> Connection:
    """A connection to the agent. Raises EngineUnavailable."""
    try:
        return Client(address, "AF_UNIX", authkey=token.encode())
    except (OSError, EOFError) as error:
        raise EngineUnavailable(f"no agent answers at {address}", "start it, or check REMOTE_AGENT") from error
    except Exception as error:  # multiprocessing.AuthenticationError
        raise EngineUnavailable(f"the agent refuses the token: {error}", "check REMOTE_TOKEN") from error


def send_json(connection: Connection, content: Any) -> None:
    """Send one value."""
    connection.send_bytes(json.dumps(content).encode())


def receive_json(connection: Connection) -> Any:
    """Receive what :func:`send_json` sent."""
    return json.loads(connection.recv_bytes(MOST_JSON_BYTES))


def send_stream(connection: Connection, stream: IO[bytes]) -> None:
    """Send the rest of a stream, and its checksum."""
    digest = hashlib.sha256()
    while chunk := stream.read(CHUNK_BYTES):
        digest.update(chunk)
        connection.send_bytes(b"+" + chunk)
    connection.send_bytes(b"=" + digest.digest())


def receive_stream(connection: Connection, stream: IO[bytes]) -> None:
    """Write what :func:`send_stream` sent, and rewind. Raises EngineUnavailable if the checksum differs."""
    digest = hashlib.sha256()
    while (data := connection.recv_bytes(CHUNK_BYTES + 1))[:1] == b"+":
        digest.update(data[1:])
        stream.write(data[1:])
    if data[1:] != digest.digest():
        raise EngineUnavailable("what arrived is not what was sent", "it is sent again")
    stream.seek(0)


def error_to_json(error: SlamHiveError) -> dict[str, Any]:
    """An error as the answer to a request."""
    return {"error": type(error).__name__, "message": error.message, "remedy": error.remedy}


def raise_error(answer: Any) -> None:
    """Raise the error that an answer stands for, if it does."""
    if isinstance(answer, dict) and "error" in answer:
        raise ERRORS.get(answer["error"], SlamHiveError)(answer["message"], answer["remedy"])
