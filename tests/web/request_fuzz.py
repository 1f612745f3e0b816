"""Requests that nobody sends in good faith: over every address and method, valid parts mixed with nasty ones."""

from __future__ import annotations

import io
import json
import random
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote_from_bytes, unquote_to_bytes

from flask import Flask
from werkzeug.routing import Map, Rule
from werkzeug.test import EnvironBuilder, TestResponse, run_wsgi_app
from werkzeug.wrappers import Request

from slamhive.web.api.operation import KEY_HEADER
from slamhive.web.security import API_HEADER
from tests.fuzzing import NASTY_BYTES, NASTY_JSON, NASTY_TEXTS, NASTY_VALUES, mutated

EXPERIMENT = """\
name: NAME
algorithms: eye-slam-mono | eye-slam-stereo
datasets: room
parameters:
  nFeatures: 500 | 1000
steps:
  image_rate: {step: rate, sensors: camera, hz: 20 | 10}
where: image_rate >= 10 or nFeatures == 500
executor: process
"""
CONFIGURATION = """\
algorithm: eye-slam-stereo
dataset: room
parameters: {nFeatures: 1500, solver: gn, note: "a note"}
playback: {mode: realtime, rate: 2.0}
name: NAME
"""
ANALYSIS = """\
name: An analysis
select:
  good: {runs: [1, 2]}
  rest: {where: "state = succeeded"}
forms:
  - {form: scatter, x: cpu.mean, y: ram.max}
  - {form: by_algorithm, metric: ate.max}
"""
RUN_FORM = {
    "algorithm": "eye-slam-stereo", "dataset": "room", "executor": "process", "repeat": "2", "seed": "7",
    "evaluate": "no", "parameter.nFeatures": "1234", "parameter.solver": "gn", "parameter.loop": "true",
    "parameter.scale": "1.1", "parameter.note": "x", "playback_mode": "realtime", "playback_rate": "1.0",
    "alignment": "", "cpu_cores": "1", "memory_mb": "2000", "timeout_s": "60", "steps": "rate hz=10",
}  # fmt: skip
CONFIGURATION_FORM = {**RUN_FORM, "name": "NAME", "note": "n", "group": "g"}
FIELDS_FORM = {
    "from": "fields", "do": "preview", "name": "NAME", "algorithms": "eye-slam-stereo", "datasets": "room",
    "parameters/nFeatures": "500 | 1000", "steps/0/name": "image_rate", "steps/0/step": "rate",
    "steps/0/sensors": "camera", "steps/0/hz": "20 | 10", "where": "nFeatures == 500", "repeats": "1", "kind": "rate",
    "limits/memory_mb": "500", "tied": "a, b", "evaluate": "yes", "executor": "process", "playback/rate": "1",
}  # fmt: skip
FORMS: Mapping[str, dict[str, str]] = {
    "start.submit": RUN_FORM,
    "configurations.create": CONFIGURATION_FORM,
    "configurations.modify": CONFIGURATION_FORM,
    "configurations.describe": {"name": "NAME", "note": "some note"},
    "configurations.group": {"group": "g", "remove": ""},
    "configurations.import_": {"text": CONFIGURATION},
    "datasets.make_variant": {"steps": "rate hz=10"},
    "runs.evaluate": {"protocol": ""},
    "runs.use_protocol": {"fingerprint": "0" * 32},
    "selected_runs.evaluate": {"run": "2", "all": "", "protocol": "", "compared": "1,2"},
    "selected_runs.evaluate_together": {"where": "id < 3", "protocol": "0123456789ab", "back": "/runs"},
    "selected_runs.retry": {"run": "2"},
    "selected_runs.tag": {"run": "2", "add": "one two", "remove": "three"},
    "selected_runs.delete": {"run": "999"},
    "search_actions.evaluate": {"count": "5", "protocol": ""},
    "search_actions.retry": {"count": "5"},
    "search_actions.tag": {"count": "5", "add": "one", "remove": "two"},
    "search_actions.share": {"count": "5", "visibility": "team"},
    "search_actions.delete": {"count": "4"},
    "trash.restore": {"run": "999", "deleted_at": ""},
    "runs.annotate": {"note": "a note", "tags": "one, two"},
    "experiments.act": {"count": "1"},
    "experiment_builder.draft": {"from": "text", "do": "start", "yaml": EXPERIMENT, "kind": "rate"},
    "searches.save": {"name": "NAME", "where": "id > 0", "sort": "id", "order": "desc", "columns": "id,state"},
    "analyses.check": {"yaml": ANALYSIS},
    "analyses.create": {"yaml": ANALYSIS, "unlisted": "1"},
    "analyses.put_in_list": {"listed": "yes"},
}
SUBMISSION: dict[str, Any] = {
    "algorithm": "eye-slam-stereo", "dataset": "room", "parameters": {"nFeatures": 800, "note": "x", "scale": 1.5},
    "repeat": 1, "executor": "process", "seed": 3, "playback_mode": "realtime", "playback_rate": 1.0,
    "evaluate": True, "alignment": None, "cpu_cores": 1.0, "memory_mb": 500, "timeout_s": 30.0, "priority": 0,
    "variant": [{"kind": "rate", "sensors": ["camera0"], "options": {"hz": 10.0}}],
}  # fmt: skip
BODIES: Mapping[str, dict[str, Any]] = {
    "api.submit": SUBMISSION,
    "api.evaluate": {"runs": [2], "alignment": "se3", "protocol": None},
    "api.preview": SUBMISSION,
    "api.preview_experiment": {"yaml": EXPERIMENT},
    "api.start_experiment": {"yaml": EXPERIMENT, "executor": "process"},
    "api.add_repeats": {"count": 1},
    "api.show_protocol": {"protocol": "0" * 12},
    "api.annotate": {"note": "a note", "tags": ["one", "two"]},
    "api.tag": {"runs": [2], "add": ["one"], "remove": ["two"]},
    "api.delete": {"runs": [999]},
    "api.evaluate_found": {"where": "id > 0", "count": 5, "protocol": None},
    "api.retry_found": {"where": "id > 0", "count": 5},
    "api.tag_found": {"where": "id > 0", "count": 5, "add": ["one"], "remove": ["two"]},
    "api.share_found": {"where": "id > 0", "count": 5, "visibility": "team"},
    "api.delete_found": {"where": "id > 0", "count": 4},
    "api.restore_together": {"deleted_at": "2026-05-04T12:00:00+00:00"},
    "api.drain_node": {"executor": "process", "node": "here"},
    "api.undrain_node": {"executor": "process", "node": "here"},
    "api.restore": {"runs": [999]},
    "api.save_search": {
        "name": "NAME", "where": "id > 0", "columns": ["id", "state"], "sort": "id", "descending": True, "group": False,
    },
    "api.create_configuration": {"submission": SUBMISSION, "name": "NAME", "note": "n", "group": "g"},
    "api.import_configuration": {"yaml": CONFIGURATION, "name": None, "note": None, "group": "g"},
    "api.modify_configuration": {"parameters": {"nFeatures": 900}, "playback_rate": 2.0, "name": "NAME"},
    "api.describe_configuration": {"name": "NAME", "note": "n"},
    "api.group_configuration": {"group": "g", "remove": False},
    "api.make_variant": {"steps": [{"kind": "rate", "sensors": ["camera0"], "options": {"hz": 10.0}}]},
    "api.create_analysis": {"yaml": ANALYSIS, "listed": False},
    "api.check_analysis": {"yaml": ANALYSIS},
    "api.list_analysis": {"listed": True},
}  # fmt: skip
QUERIES = {
    "where": "id > 0 and state = succeeded", "state": "failed", "reason": "timeout", "algorithm": "eye-slam-stereo",
    "dataset": "room", "sensor": "camera", "executor": "process", "experiment": "trial", "configuration": "1",
    "from": "2026-01-01", "to": "2026-12-31", "evaluated": "yes", "min.ate.rmse": "0.01", "max.cpu.mean": "4",
    "sort": "ate.rmse", "order": "asc", "columns": "id,state,ate.rmse", "limit": "20", "after": "WzFd",
    "group": "configuration", "text": "a", "used": "yes", "copy": "1", "protocol": "evo", "page": "1",
    "rows": "algorithm", "grid": "now", "v": "1", "sensors": "camera", "datasets": "room",
    "parameter.nFeatures": "700", "steps": "rate hz=5", "repeat": "2", "runs": "1,2", "run": "1",
}  # fmt: skip
HEADERS = (
    "Host", "Origin", "Referer", "Content-Type", "Content-Length", "Range", "If-Range", "If-None-Match",
    "If-Modified-Since", "Accept", "Accept-Encoding", "Accept-Language", "Cookie", "Last-Event-ID",
    "Transfer-Encoding", "X-Forwarded-For", "X-Forwarded-Host", "Forwarded", "Authorization", "X-CSRFToken",
    API_HEADER, KEY_HEADER, "Sec-Fetch-Site", "Expect", "User-Agent",
)  # fmt: skip
NASTY_HEADERS = (
    "", "*", "http://[::1", "http://[", "[::1", "::1", "//", "null", "localhost:99999999", "localhost:x", "a@b:c",
    "bytes=0-", "bytes=9-1", "bytes=-", "bytes=0-0,5-9,-1", "bytes=" + "0-1," * 500, "items=x", '"', 'W/"x',
    '"a", W/"b", *', "Thu, 99 Xxx 9999 99:99:99 GMT", "-1", "1e9", "99999999999999999999", "text/html;q=x",
    "application/json;q=nan", "application/json", "text/*;q=-1,;;,", "multipart/form-data",
    'multipart/form-data; boundary="', "multipart/form-data; boundary=" + "x" * 300,
    "application/x-www-form-urlencoded; charset=utf-7", "application/json; charset=utf-16",
    "text/plain; charset=klingon", "slamhive=garbage.x.y", "slamhive=eyJ9.x.y; slamhive=", "=;=;;",
    "slamhive=" + "A" * 5000, "chunked", "gzip, chunked", "100-continue", "\xff\xfe", "é", "a" * 5000, "evil.example",
    "%00", "<script>",
)  # fmt: skip
METHODS = ("GET", "HEAD", "OPTIONS", "POST", "PUT", "DELETE", "PATCH", "TRACE", "CONNECT", "FOO", "get")


@dataclass
class FuzzedRequest:
    """One request, as it comes out of the server's socket."""

    endpoint: str
    method: str
    path: str
    query: bytes
    body: Mapping[str, Any]
    headers: Mapping[str, str]

    def send(self, app: Flask, cookie: str) -> TestResponse:
        """The application's answer. Nothing is corrected on the way, as a test client would."""
        builder = EnvironBuilder(path="/", method=self.method, **self.body)
        environ = builder.get_environ()
        builder.close()
        environ["PATH_INFO"] = unquote_to_bytes(self.path).decode("latin-1")
        environ["QUERY_STRING"] = self.query.decode("latin-1")
        environ["HTTP_COOKIE"] = f"slamhive={cookie}"
        for name, text in self.headers.items():
            key = name.upper().replace("-", "_")
            environ[key if key in ("CONTENT_TYPE", "CONTENT_LENGTH") else f"HTTP_{key}"] = text
        return TestResponse(*run_wsgi_app(app.wsgi_app, environ), Request(environ))

    def __str__(self) -> str:
        address = f"{self.path[:300]}?{self.query[:300]!r}"
        return f"{self.method} {self.endpoint} {address} {self.headers} {repr(self.body)[:1500]}"


class Requests:
    """An endless supply of requests.

    Args:
        rules: The addresses of the application.
        values: Valid values of the arguments of addresses, by name.
        token: A valid CSRF token, so that forms reach the code behind them.
        seed: Equal seeds give equal requests.
    """

    def __init__(self, rules: Map, values: Mapping[str, list[str]], token: str, seed: int) -> None:
        self._targets = [(rule, method) for rule in rules.iter_rules() for method in sorted(rule.methods or ())]
        self._changes = [target for target in self._targets if target[1] == "POST"]
        self._values, self._token, self._draw = values, token, random.Random(seed)
        self._made = 0

    def next(self) -> FuzzedRequest:
        """Another one. Every address and method comes in its turn, those that change things more often."""
        draw = self._draw
        self._made += 1
        rule, method = draw.choice(self._changes if draw.random() < 0.45 else self._targets)
        if draw.random() < 0.04:
            method = draw.choice(METHODS)
        headers: dict[str, str] = {}
        if rule.endpoint.startswith("api") and draw.random() < 0.95:
            headers[API_HEADER] = "1"
        if draw.random() < 0.15:
            headers["Accept"] = "application/json"
        body = {} if method in ("GET", "HEAD", "OPTIONS", "TRACE") else self._body(rule)
        if draw.random() < 0.2:
            for name in draw.sample(HEADERS, draw.choice((1, 1, 2, 4))):
                headers[name] = draw.choice(NASTY_HEADERS)
        return FuzzedRequest(rule.endpoint, method, self._path(rule), self._query(rule), body, headers)

    def _path(self, rule: Rule) -> str:
        path = rule.rule
        for name in sorted(rule.arguments):
            valid = self._values.get(name, ["x"])
            text = self._draw.choice(valid) if self._draw.random() < 0.85 else None
            piece = self._nasty_path() if text is None else quote_from_bytes(text.encode())
            path = re.sub(rf"<(?:[^<>]*:)?{name}>", lambda _found, piece=piece: piece, path)  # type: ignore[misc]
        if self._draw.random() < 0.02:
            path += self._draw.choice(("/", "//", "%00", "%2e%2e/", "/../", ";x", "%ff", "%0d%0aX: y"))
        return path

    def _nasty_path(self) -> str:
        draw = self._draw
        data = draw.choice(NASTY_BYTES) if draw.random() < 0.4 else draw.choice(NASTY_TEXTS).encode()
        return quote_from_bytes(data[:4000], safe=draw.choice(("", "/")))

    def _query(self, rule: Rule) -> bytes:
        draw = self._draw
        if rule.endpoint in FORMS or draw.random() < 0.4:
            return b""
        if draw.random() < 0.05:
            return quote_from_bytes(draw.choice(NASTY_BYTES), safe="=&;[]").encode() * draw.choice((1, 1, 40))
        known = {**QUERIES, **RUN_FORM} if "new" in rule.rule else QUERIES
        names = draw.sample(sorted(known), draw.choice((1, 1, 2, 3, 5)))
        pairs = [(name, known[name] if draw.random() < 0.5 else draw.choice(NASTY_TEXTS)) for name in names]
        if draw.random() < 0.1:
            pairs.append(pairs[0])
        return b"&".join(f"{_quoted(name)}={_quoted(text)}".encode() for name, text in pairs)

    def _body(self, rule: Rule) -> dict[str, Any]:
        if rule.endpoint in BODIES:
            return {"data": self._json(BODIES[rule.endpoint]), "content_type": "application/json"}
        return self._form(FORMS.get(rule.endpoint, {}))

    def _json(self, body: dict[str, Any]) -> bytes:
        draw = self._draw
        body = json.loads(self._named(json.dumps(body)))
        for _ in range(draw.choice((0, 1, 1, 1, 2))):
            self._spoil(body)
        text = json.dumps(body)
        if draw.random() < 0.25:
            value = draw.choice(re.findall(r': ("[^"]*"|[0-9.]+|null|true)', text) or ["x"])
            text = text.replace(f": {value}", f": {draw.choice(NASTY_JSON)}", 1)
        data = text.encode("utf-8", "surrogatepass")
        return mutated(data, draw) if draw.random() < 0.12 else data

    def _spoil(self, body: Any) -> None:
        """Put something nasty into one place of a JSON value, at any depth."""
        draw = self._draw
        inner = [item for item in (body.values() if isinstance(body, dict) else body) if isinstance(item, dict | list)]
        inner = [item for item in inner if item]
        if inner and draw.random() < 0.5:
            self._spoil(draw.choice(inner))
            return
        key = draw.choice(sorted(body)) if isinstance(body, dict) else draw.randrange(len(body))
        text = body[key]
        if isinstance(text, str) and "\n" in text and draw.random() < 0.85:
            body[key] = self._text(text)
            return
        body[key] = draw.choice(NASTY_VALUES)
        if isinstance(body, dict) and draw.random() < 0.1:
            body[str(draw.choice(NASTY_TEXTS))] = body.pop(key)

    def _form(self, form: dict[str, str]) -> dict[str, Any]:
        draw = self._draw
        if form.get("from") == "text" and draw.random() < 0.4:
            form = FIELDS_FORM
        fields = {name: self._named(text) for name, text in form.items()}
        for name in draw.sample(sorted(fields), min(len(fields), draw.choice((0, 1, 1, 1, 2)))):
            fields[name] = self._text(fields[name])
        if draw.random() < 0.05:
            fields[draw.choice(NASTY_TEXTS)[:200]] = draw.choice(NASTY_TEXTS)
        if draw.random() < 0.97:
            fields["csrf_token"] = self._token
        if draw.random() < 0.1:
            text = next((text for text in form.values() if "\n" in text), "x: 1")
            name = draw.choice(("a.yaml", "a\x00.yaml", "", "../../x", "é" * 100, "a" * 3000))
            return {"data": {**fields, "do": "open", "file": (io.BytesIO(mutated(text.encode(), draw)), name)}}
        if draw.random() < 0.04:
            return {"data": mutated("&".join(f"{_quoted(k)}={_quoted(v)}" for k, v in fields.items()).encode(), draw),
                    "content_type": "application/x-www-form-urlencoded"}  # fmt: skip
        if draw.random() < 0.05:
            return {"data": {name: [text, text, ""] for name, text in fields.items()}}
        return {"data": fields}

    def _text(self, text: str) -> str:
        """Another text; one of several lines only changes in a place, and is still read for the most part."""
        if "\n" not in text or self._draw.random() < 0.1:
            return self._draw.choice(NASTY_TEXTS)
        return mutated(text.encode(), self._draw).decode("utf-8", "replace")

    def _named(self, text: str) -> str:
        return text.replace("NAME", f"n{self._made}")


def _quoted(text: str) -> str:
    return quote_from_bytes(text.encode("utf-8", "surrogatepass"), safe="")
