"""Which HTTP status stands for which error: the web answers by it, and clients raise by it."""

from __future__ import annotations

from slamhive.errors import (
    Conflict,
    Forbidden,
    InvalidInput,
    NotFound,
    SlamHiveError,
    TooManyRequests,
    Unauthenticated,
    Unavailable,
)

STATUS: dict[type[SlamHiveError], int] = {
    InvalidInput: 400,
    Unauthenticated: 401,
    Forbidden: 403,
    NotFound: 404,
    Conflict: 409,
    TooManyRequests: 429,
    Unavailable: 503,
}
