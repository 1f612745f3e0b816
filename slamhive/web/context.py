"""Access to the services and helpers of the current application."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

from flask import current_app, g

if TYPE_CHECKING:
    from slamhive.base.budget import Budget
    from slamhive.domain.accounts import Caller
    from slamhive.services.hive import Hive
    from slamhive.services.stored_analyses import AnalysisComputer
    from slamhive.web.access import Callers
    from slamhive.web.import_jobs import ImportJobs
    from slamhive.web.limits import RateLimit, SignInLimits
    from slamhive.web.live import LiveHub
    from slamhive.web.long_work import DatasetChecker, DatasetFetcher, DemoWork, TruthJudge, VariantMaker
    from slamhive.web.oidc import IdentityProvider

EXTENSION = "slamhive"
BUDGET_EXTENSION = "slamhive-budget"
LIVE_EXTENSION = "slamhive-live"
VARIANTS_EXTENSION = "slamhive-variants"
CHECKS_EXTENSION = "slamhive-dataset-checks"
FETCH_EXTENSION = "slamhive-fetch"
DEMO_EXTENSION = "slamhive-demo"
TRIALS_EXTENSION = "slamhive-truth-trials"
PROVIDER_EXTENSION = "slamhive-oidc"
IMPORTS_EXTENSION = "slamhive-imports"
COMPUTER_EXTENSION = "slamhive-analyses"
RATES_EXTENSION = "slamhive-rates"
CALLERS_EXTENSION = "slamhive-callers"
SIGN_IN_EXTENSION = "slamhive-sign-in"


def hive() -> Hive:
    """The services of this application."""
    return cast("Hive", current_app.extensions[EXTENSION])


def budget() -> Budget:
    """The budget of all requests of the server together."""
    return cast("Budget", current_app.extensions[BUDGET_EXTENSION])


def live_hub() -> LiveHub:
    """The hub of live updates."""
    return cast("LiveHub", current_app.extensions[LIVE_EXTENSION])


def variant_maker() -> VariantMaker:
    """The background creator of variants."""
    return cast("VariantMaker", current_app.extensions[VARIANTS_EXTENSION])


def dataset_checker() -> DatasetChecker:
    """The background checker of datasets."""
    return cast("DatasetChecker", current_app.extensions[CHECKS_EXTENSION])


def dataset_fetcher() -> DatasetFetcher:
    """The background download of public sequences."""
    return cast("DatasetFetcher", current_app.extensions[FETCH_EXTENSION])


def demo_work() -> DemoWork:
    """The background preparation of the demo."""
    return cast("DemoWork", current_app.extensions[DEMO_EXTENSION])


def truth_judge() -> TruthJudge:
    """The background judge of ground truths."""
    return cast("TruthJudge", current_app.extensions[TRIALS_EXTENSION])


def import_jobs() -> ImportJobs:
    """The imports in the background."""
    return cast("ImportJobs", current_app.extensions[IMPORTS_EXTENSION])


def analysis_computer() -> AnalysisComputer | None:
    """The thread that computes analyses; None where a worker does."""
    return cast("AnalysisComputer | None", current_app.extensions[COMPUTER_EXTENSION])


def rate_limit(name: str) -> RateLimit:
    """The rate limit with this name."""
    return cast("dict[str, RateLimit]", current_app.extensions[RATES_EXTENSION])[name]


def callers() -> Callers:
    """Finds the caller of a request."""
    return cast("Callers", current_app.extensions[CALLERS_EXTENSION])


def caller() -> Caller:
    """The sender of this request, found before any page code runs."""
    return cast("Caller", g.get("caller") or callers().unknown)


def provider() -> IdentityProvider | None:
    """The provider of OpenID Connect; None if the settings name none."""
    return cast("IdentityProvider | None", current_app.extensions[PROVIDER_EXTENSION])


def sign_in_limits() -> SignInLimits:
    """The limits of failed attempts to sign in."""
    return cast("SignInLimits", current_app.extensions[SIGN_IN_EXTENSION])
