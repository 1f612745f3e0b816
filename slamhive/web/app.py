"""Assembles the Flask application."""

from __future__ import annotations

from contextlib import ExitStack
from datetime import timedelta
from typing import Any

from flask import Flask, Response, g, request
from flask_bootstrap import Bootstrap5
from flask_wtf.csrf import CSRFProtect
from markupsafe import Markup

from slamhive import __version__
from slamhive.analysis.chart import on_dark
from slamhive.base.budget import Budget, Lent
from slamhive.base.clock import utc_now
from slamhive.base.files import relative_paths
from slamhive.base.settings import Mode, Settings
from slamhive.domain.accounts import VISIBILITY_LABELS, Action, Role
from slamhive.domain.run import RunState
from slamhive.domain.verdict import outcome_words
from slamhive.services.hive import Hive
from slamhive.services.markdown import markdown_html
from slamhive.services.searches import runs_text
from slamhive.services.stored_analyses import may_analyse
from slamhive.store import Store
from slamhive.web import api, assets, context, formatting, pages
from slamhive.web.caching import PageCache, add_caching, add_compression, keep_pages
from slamhive.web.columns import ColumnKind
from slamhive.web.errors import handle_errors, hide_paths
from slamhive.web.import_jobs import ImportJobs
from slamhive.web.limits import SignInLimits, visitor_limits
from slamhive.web.live import LiveHub
from slamhive.web.long_work import DatasetChecker, DatasetFetcher, DemoWork, TruthJudge, VariantMaker
from slamhive.web.oidc import find_provider
from slamhive.web.pages import register_pages
from slamhive.web.presenters import catalogue as catalogue_presenter
from slamhive.web.security import protect, secret_key
from slamhive.web.views import (
    accounts,
    analyses,
    api_docs,
    catalogue,
    challenges,
    compare,
    configurations,
    dashboard,
    experiments,
    imports,
    run_plots,
    runs,
    search,
    search_actions,
    selected_runs,
    start,
)
from slamhive.web.views import help as help_pages
from slamhive.web.views.challenges import MOST_SENT_BYTES

MOST_UPLOAD_BYTES = 1_000_000
BODY_LIMITS = {
    **{f"{api.blueprint.name}.{name}": most for name, most in api.TABLE.body_limits.items()},
    f"{challenges.blueprint.name}.submit": MOST_SENT_BYTES,
    f"{imports.blueprint.name}.look": imports.MOST_SENT_BYTES,
}
"""{endpoint: the most bytes of its body}, where that is more than :data:`MOST_UPLOAD_BYTES`."""
MOST_STREAMS = 8
MB = 1_000_000
_ACCOUNT_BLUEPRINTS = (accounts.blueprint, accounts.administration_blueprint)
_BLUEPRINTS = (
    dashboard.blueprint,
    catalogue.algorithms_blueprint,
    configurations.blueprint,
    catalogue.blueprint,
    catalogue.public_blueprint,
    start.blueprint,
    runs.blueprint,
    run_plots.blueprint,
    run_plots.scenes_blueprint,
    search_actions.blueprint,
    selected_runs.blueprint,
    selected_runs.trash_blueprint,
    dashboard.nodes_blueprint,
    challenges.blueprint,
    compare.blueprint,
    compare.claims_blueprint,
    experiments.blueprint,
    experiments.experiment_builder_blueprint,
    experiments.questions_blueprint,
    search.blueprint,
    search.finding_blueprint,
    analyses.blueprint,
    imports.blueprint,
    imports.server_blueprint,
    help_pages.blueprint,
    api.blueprint,
    api_docs.blueprint,
    assets.blueprint,
)


def create_app(hive: Hive, host: str | None = None) -> Flask:
    """Create the web application.

    Args:
        hive: The services, the only interface that pages use.
        host: Address the server binds to; it decides which Host headers are accepted. None: from the settings.
    """
    root = hive.catalogue.project_root
    app = Flask("slamhive.web", template_folder=str(root / "templates"), static_folder=str(root / "static"))
    app.config.update(
        SECRET_KEY=secret_key(hive.settings),
        SESSION_COOKIE_NAME="slamhive",
        SESSION_COOKIE_HTTPONLY=True,
        SESSION_COOKIE_SAMESITE="Lax",
        PERMANENT_SESSION_LIFETIME=timedelta(days=30),
        MAX_CONTENT_LENGTH=MOST_UPLOAD_BYTES,
        MAX_FORM_PARTS=2000,
        BOOTSTRAP_SERVE_LOCAL=True,
        WTF_CSRF_TIME_LIMIT=None,
        WTF_CSRF_CHECK_DEFAULT=True,
    )
    app.extensions[context.EXTENSION] = hive
    hide_paths(app, relative_paths(hive.settings.data, root))
    app.extensions[context.BUDGET_EXTENSION] = lent_to_requests(hive.settings)
    app.extensions[context.LIVE_EXTENSION] = LiveHub(hive, MOST_STREAMS)
    app.extensions[context.VARIANTS_EXTENSION] = VariantMaker(hive)
    app.extensions[context.CHECKS_EXTENSION] = DatasetChecker(hive)
    app.extensions[context.FETCH_EXTENSION] = DatasetFetcher(hive)
    app.extensions[context.DEMO_EXTENSION] = DemoWork(hive)
    app.extensions[context.TRIALS_EXTENSION] = TruthJudge(hive)
    app.extensions[context.IMPORTS_EXTENSION] = ImportJobs(hive, app.extensions[context.BUDGET_EXTENSION])
    # On a view-only server that accepts analyses, the web server computes them, because no worker runs.
    computes = hive.settings.mode is Mode.VIEW_ONLY and may_analyse(hive.settings)
    app.extensions[context.COMPUTER_EXTENSION] = hive.analysis_computer() if computes else None
    app.extensions[context.RATES_EXTENSION] = visitor_limits(hive.settings.analyses_per_hour_per_address)
    app.jinja_options["trim_blocks"] = True
    app.jinja_options["lstrip_blocks"] = True
    # Flask runs ``after_request`` functions in the reverse order of their registration. Answers get their security
    # headers, then an ETag, and are compressed last.
    add_compression(app)
    add_caching(app)
    app.extensions[context.SIGN_IN_EXTENSION] = SignInLimits()

    # Before anything looks at a body: uploads may have larger ones than other requests.
    @app.before_request
    def allow_parts_of_files() -> None:
        most = BODY_LIMITS.get(request.endpoint or "")
        if most is not None:
            request.max_content_length = most

    callers = protect(app, hive, host or hive.settings.host)
    # A page is kept once it has passed the checks, and answered before them: what they look at (host, method) is in
    # its key, and everybody sees the same. Where callers sign in that would not be so.
    if hive.settings.mode is Mode.VIEW_ONLY and not callers.needed:
        keep_pages(app, PageCache())
    _show_one_moment(app, hive.store)
    Bootstrap5(app)
    csrf = CSRFProtect(app)
    csrf.exempt(api.blueprint)  # its changes need a header of ours, which no web form of another site can send
    handle_errors(app)
    app.extensions[context.PROVIDER_EXTENSION] = None
    if callers.needed:
        app.extensions[context.PROVIDER_EXTENSION] = find_provider(app, hive.settings)
        for blueprint in _ACCOUNT_BLUEPRINTS:
            app.register_blueprint(blueprint)
    register_blueprints(app)
    _add_template_words(app, hive)
    app.jinja_env.globals["needs_account"] = callers.needed
    return app


def lent_to_requests(settings: Settings) -> Budget:
    """The budget of all requests that bring files."""
    return Budget(
        {
            Lent.MEMORY: settings.requests_memory_mb * MB,
            Lent.DISK: settings.requests_disk_mb * MB,
            Lent.UNPACKED: settings.uploads_max_bytes,
            Lent.SUBMISSIONS: 2,
            Lent.IMAGES: 1,
            Lent.IMPORTS: 3,
        }
    )


def _show_one_moment(app: Flask, store: Store) -> None:
    """All that a page shows is read in one transaction, so its numbers fit together while a worker writes."""

    @app.before_request
    def begin() -> None:
        if request.method in ("GET", "HEAD"):
            g.snapshot = ExitStack()
            g.snapshot.enter_context(store.snapshot())

    def end() -> None:
        g.pop("snapshot", ExitStack()).close()

    @app.after_request
    def end_with_response(response: Response) -> Response:
        end()  # before a stream of updates or a large file begins
        return response

    @app.teardown_request
    def end_with_error(_error: BaseException | None) -> None:
        end()


def register_blueprints(app: Flask) -> None:
    """Register our own pages, then those of plug-ins."""
    for blueprint in _BLUEPRINTS:
        app.register_blueprint(blueprint)
    register_pages(app)


def check_plugin_pages() -> None:
    """Register all pages on an application that serves nobody, which finds the plug-ins whose pages do not fit."""
    register_blueprints(Flask("slamhive.web"))


def _add_template_words(app: Flask, hive: Hive) -> None:
    """Add filters and names for all templates."""

    def has_algorithm(name: str) -> bool:
        if "algorithm_names" not in g:  # read once for each request: a list asks for every row
            g.algorithm_names = frozenset(entry.name for entry in hive.catalogue.algorithms())
        return name in g.algorithm_names

    app.jinja_env.filters.update(
        duration=formatting.duration,
        exact_time=formatting.exact_time,
        iso_time=formatting.iso_time,
        on_dark=on_dark,
        outcome_words=outcome_words,
        markdown=lambda text: Markup(markdown_html(text)),  # noqa: S704 - markdown_html escapes HTML
        plural=formatting.plural,
        mean_text=formatting.mean_text,
        significant=formatting.significant,
        size=formatting.size,
        thousands=formatting.thousands,
        value_text=formatting.value_text,
    )
    app.jinja_env.globals.update(
        Kind=ColumnKind,
        RunState=RunState,
        asset=assets.asset_url,
        runs_text=runs_text,
        has_challenges=lambda: bool(hive.challenges.names()),
        has_claims=lambda: bool(hive.claims.names()),
        has_algorithm=has_algorithm,
        catalogue=catalogue_presenter,
        frame=pages,
        help_of=help_pages.OF_PAGE,
        relative_time=formatting.relative_time,
        version=__version__,
        visibility_labels=VISIBILITY_LABELS,
        zip=zip,
    )

    @app.context_processor
    def request_words() -> dict[str, Any]:
        caller = context.caller()

        def may_share(owner: str | None) -> bool:
            changes = caller.role is not None and Action.CHANGE in caller.may  # without accounts, nobody has a role
            return changes and (caller.role is Role.ADMIN or owner == caller.account)

        view_only = Action.CHANGE not in caller.may
        return {"now": utc_now(), "caller": caller, "view_only": view_only, "may_share": may_share}
