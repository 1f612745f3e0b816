"""The header ``Idempotency-Key``: a change that is sent again is not done again."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from functools import wraps
from typing import Any

from flask import Response, request

from slamhive.base.errors import SlamHiveError
from slamhive.services.kept_answers import KeptAnswer
from slamhive.web.context import caller, hive
from slamhive.web.request_input import answer

KEY_HEADER = "Idempotency-Key"
REPEATED_HEADER = "Idempotency-Replayed"


def once(view: Callable[..., Response]) -> Callable[..., Response]:
    """A view that does nothing for a request whose key is known, and answers as the first time."""

    @wraps(view)
    def respond(**values: Any) -> Response:
        key = request.headers.get(KEY_HEADER)
        if key is None:
            return view(**values)
        kept = hive().kept_answers.of(caller().account or "")
        known = kept.claim(key, _fingerprint())
        if known is not None:
            repeated = answer(json.loads(known.body), known.status)
            repeated.headers[REPEATED_HEADER] = "true"
            return repeated
        try:
            response = view(**values)
        except SlamHiveError:
            kept.release(key)  # a refusal changes nothing, so the request may be sent again
            raise
        kept.keep(key, KeptAnswer(response.status_code, response.get_data(as_text=True)))
        return response

    return respond


def _fingerprint() -> str:
    """Identifies what was asked for."""
    digest = hashlib.sha256(f"{request.method} {request.full_path}\n".encode())
    digest.update(request.get_data())
    return digest.hexdigest()
