"""Signing in at a provider of OpenID Connect: authorization code flow with PKCE, state and nonce, by Authlib."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, cast

import requests
from flask import Flask, Response

from slamhive.base.errors import InvalidInput, Unauthenticated, Unavailable
from slamhive.base.settings import Settings
from slamhive.domain.accounts import Identity, is_provider_address

_NAME = "oidc"
_DISCOVERY = "/.well-known/openid-configuration"
_TIMEOUT_S = 10.0
_SHOWN = 200
_NAMES = ("preferred_username", "email", "name")
"""Claims that say what to call somebody, the best one first."""


class IdentityProvider:
    """The provider of the settings. Nothing is asked of it before somebody wants to sign in.

    Args:
        client: Of Authlib.
        issuer: Its address, which its tokens must name.
        client_id: For whom its tokens must be.
    """

    def __init__(self, client: Any, issuer: str, client_id: str) -> None:
        self._client = client
        self._issuer = issuer
        self._client_id = client_id

    def go(self, back: str) -> Response:
        """The way to the provider, which sends its users to the address ``back``; raises Unavailable."""
        with self._explained():
            return cast("Response", self._client.authorize_redirect(back))

    def returned(self) -> Identity:
        """The identity that the provider gives to the sender of this request.

        Raises Unauthenticated if it refuses, or if its answer is not for this browser, this server and this moment.
        Raises Unavailable if it does not answer.
        """
        wanted = {
            "iss": {"essential": True, "value": self._issuer},
            "aud": {"essential": True, "value": self._client_id},
            "sub": {"essential": True},
            "exp": {"essential": True},
        }
        with self._explained():
            claims = self._client.authorize_access_token(claims_options=wanted).get("userinfo")
        if not claims:
            raise Unauthenticated("the provider sent no ID token", "allow the scope openid for this client")
        name = next((str(claims[key]) for key in _NAMES if claims.get(key)), "")
        return Identity(self._issuer, str(claims["sub"]), name)

    @contextmanager
    def _explained(self) -> Iterator[None]:
        from authlib.common.errors import AuthlibBaseError  # noqa: PLC0415 - optional
        from joserfc.errors import JoseError  # noqa: PLC0415 - comes with Authlib

        try:
            yield
        except (AuthlibBaseError, JoseError) as error:
            said = error.description or error.error or type(error).__name__
            raise Unauthenticated(f"signing in at {self._issuer} failed: {said[:_SHOWN]}", "try again") from None
        except requests.RequestException as error:
            raise Unavailable(
                f"{self._issuer} does not answer: {type(error).__name__}", "try again, or use name and password"
            ) from None
        except (ValueError, KeyError, TypeError, RuntimeError) as error:
            # What is not JSON, lacks a key, or cannot be decoded comes out of the libraries in these ways.
            raise Unauthenticated(
                f"{self._issuer} sent an answer that is not valid: {str(error)[:_SHOWN]}", "ask its admins"
            ) from None


def find_provider(app: Flask, settings: Settings) -> IdentityProvider | None:
    """The provider of the settings; None if they name none.

    Raises InvalidInput for settings that cannot be used, and Unavailable if Authlib is not installed.
    """
    issuer = settings.oidc_issuer
    if not issuer:
        return None
    if not is_provider_address(issuer):
        raise InvalidInput(f"OIDC_ISSUER expects an address, got {issuer[:_SHOWN]!r}", "begin it with https://")
    if not settings.oidc_client_id:
        raise InvalidInput("OIDC_CLIENT_ID is not set", "register this server at the provider, which names it")
    try:
        from authlib.integrations.flask_client import OAuth  # noqa: PLC0415 - optional
    except ImportError:
        raise Unavailable("OIDC_ISSUER needs Authlib, which is not installed", "pip install slamhive[oidc]") from None
    client = OAuth(app).register(
        _NAME,
        client_id=settings.oidc_client_id,
        client_secret=settings.oidc_client_secret or None,
        server_metadata_url=issuer.rstrip("/") + _DISCOVERY,
        client_kwargs={
            "scope": "openid profile email",
            "code_challenge_method": "S256",
            "timeout": _TIMEOUT_S,
            "token_endpoint_auth_method": "client_secret_basic" if settings.oidc_client_secret else "none",
        },
    )
    return IdentityProvider(client, issuer, settings.oidc_client_id)
