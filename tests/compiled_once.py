"""What each application and each database compiles for itself, tests compile once: addresses, templates and statements.

Tests make thousands of both in a process, whose programs make one. Addresses and statements are shared in a process,
templates by all processes of a test run.
"""

from __future__ import annotations

import sys
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tests.sharing import made_once

if TYPE_CHECKING:
    from flask import Flask
    from jinja2 import BytecodeCache, Environment
    from sqlalchemy import Engine
    from werkzeug.routing import Rule

_replaced: dict[str, Any] = {}
"""What took the place of a function of a library, by the function's name."""
_addresses: dict[tuple[object, ...], Rule] = {}
"""Bound rules of an application, by all that decides how they are compiled."""


def compile_once() -> None:
    """From now on this process compiles each address, template and statement once; what is not imported is left."""
    if (rules := sys.modules.get("werkzeug.routing.rules")) is not None:
        _replace(rules.Rule, "compile", _compiled_address)
    if (app := sys.modules.get("flask.app")) is not None:
        _replace(app.Flask, "create_jinja_environment", _environment_with_templates)
        _shared_templates()  # now: a test may empty the environment, which names the folder where they are
    if "sqlalchemy.dialects.sqlite.pysqlite" in sys.modules:
        from sqlalchemy.dialects.sqlite.pysqlite import SQLiteDialect_pysqlite  # noqa: PLC0415 - slow to load
        from sqlalchemy.engine import Engine  # noqa: PLC0415

        _replace(Engine, "_compiled_cache", property(_kept_statements, _keep_statements))
        # A statement is found by its dialect too. Those of SQLite files differ in nothing that it is compiled to.
        _replace(SQLiteDialect_pysqlite, "__eq__", lambda ours, other: type(ours) is type(other))
        _replace(SQLiteDialect_pysqlite, "__hash__", lambda ours: hash(type(ours)))


def _replace(owner: type, name: str, ours: Any) -> None:
    key = f"{owner.__name__}.{name}"
    if key not in _replaced:
        _replaced[key] = getattr(owner, name, None)
        setattr(owner, name, ours)


def _compiled_address(rule: Rule) -> None:
    """Take the place of ``Rule.compile``."""
    own = (rule.rule, rule.subdomain, rule.host, rule.merge_slashes, repr(rule.defaults))
    key = (*own, rule.map.host_matching, *rule.map.converters.items())
    if key not in _addresses:
        _replaced["Rule.compile"](rule)
        _addresses[key] = rule
        return
    before = _addresses[key]
    rule._parts, rule._trace, rule._converters = list(before._parts), list(before._trace), dict(before._converters)
    rule.arguments = rule.arguments | before.arguments
    rule._build = before._build.__func__.__get__(rule, None)  # type: ignore[attr-defined]
    rule._build_unknown = before._build_unknown.__func__.__get__(rule, None)  # type: ignore[attr-defined]


def _environment_with_templates(app: Flask) -> Environment:
    """Take the place of ``Flask.create_jinja_environment``."""
    environment: Environment = _replaced["Flask.create_jinja_environment"](app)
    environment.bytecode_cache = _shared_templates()
    return environment


@cache
def _shared_templates() -> BytecodeCache:
    from jinja2 import FileSystemBytecodeCache  # noqa: PLC0415 - slow to load

    class TemplatesCompiledOnce(FileSystemBytecodeCache):
        """Finds a template by its name, wherever the installation lies; the checksum of its source must still agree."""

        def get_cache_key(self, name: str, filename: str | None = None) -> str:
            return super().get_cache_key(name)

    return TemplatesCompiledOnce(str(made_once("templates", Path.mkdir)))


def _kept_statements(engine: Engine) -> Any:
    """What is read as ``Engine._compiled_cache``."""
    return _statements() if engine.dialect.name == "sqlite" else engine.__dict__["_compiled_cache"]


def _keep_statements(engine: Engine, statements: Any) -> None:
    """What is called to set ``Engine._compiled_cache``."""
    engine.__dict__["_compiled_cache"] = statements


@cache
def _statements() -> Any:
    from sqlalchemy.util import LRUCache  # noqa: PLC0415 - slow to load

    return LRUCache(5_000)
