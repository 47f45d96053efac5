"""Access control of the server: host names, token, origin of changes; and the headers of every answer.

A page of another site may send requests to a server on this machine (DNS rebinding, forged forms), so a request names a
host that is ours, and a change comes from our own page or from no page at all.
"""

from __future__ import annotations

import hmac
import ipaddress
from collections.abc import Mapping
from dataclasses import dataclass

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

PAGE_POLICY = (
    "default-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; object-src 'none';"
    " require-trusted-types-for 'script'"
)
_HEADERS = {
    "content-security-policy": PAGE_POLICY,
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "permissions-policy": "camera=(), microphone=(), geolocation=()",
}
# Names the operator's token in the environment.
TOKEN_VARIABLE = "MESHCTL_MONITOR_TOKEN"
_LOOPBACK_NAMES = frozenset(("localhost",))


@dataclass(frozen=True, slots=True)
class AccessRules:
    """`token` empty: none is needed. `host_names` are accepted in addition to loopback or, with `accept_addresses`, any
    IP address (an address cannot be rebound; a name can)."""

    token: str = ""
    host_names: frozenset[str] = frozenset()
    accept_addresses: bool = False

    def accepts_host(self, header: str) -> bool:
        host = host_of(header)
        if host in _LOOPBACK_NAMES or host in self.host_names:
            return True
        try:
            address = ipaddress.ip_address(host)
        except ValueError:
            return False
        return self.accept_addresses or address.is_loopback

    def accepts_token(self, headers: Mapping[str, str]) -> bool:
        if not self.token:
            return True
        scheme, _, given = headers.get("authorization", "").partition(" ")
        return scheme.lower() == "bearer" and hmac.compare_digest(given.strip().encode(), self.token.encode())

    def may_change(self, client_host: str) -> bool:
        """Whether this client may acknowledge alarms: it has the token, or runs on this machine."""
        return bool(self.token) or is_loopback(client_host)


def host_of(header: str) -> str:
    """The host of a Host header, lower case, without port and brackets."""
    host = header.strip().lower()
    if host.startswith("["):
        return host[1:].partition("]")[0]
    return host.partition(":")[0].rstrip(".")


def is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host in _LOOPBACK_NAMES


class AccessControl:
    """ASGI middleware that applies `AccessRules`. The page's own files hold no data and need no token."""

    def __init__(self, app: ASGIApp, rules: AccessRules) -> None:
        self._app = app
        self._rules = rules

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in _HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        refusal = self._refusal(scope)
        await (self._app if refusal is None else refusal)(scope, receive, with_headers)

    def _refusal(self, scope: Scope) -> JSONResponse | None:
        headers = Headers(scope=scope)
        path: str = scope["path"]
        if not self._rules.accepts_host(headers.get("host", "")):
            return error_response(421, "this server does not have that host name; start it with --host-name NAME")
        if path.startswith("/api/") or path == "/metrics":
            # `none`: typed into the address bar; programs send no such header
            if headers.get("sec-fetch-site", "none") not in ("same-origin", "none"):
                return error_response(403, "the request comes from another site's page")
            if not self._rules.accepts_token(headers):
                return error_response(401, "the token is missing or wrong", {"WWW-Authenticate": "Bearer"})
        if scope["method"] not in ("GET", "HEAD"):
            if headers.get("sec-fetch-site", "same-origin") != "same-origin":
                return error_response(403, "the request comes from another site's page")
            origin = headers.get("origin")
            if origin is not None and origin.partition("://")[2] != headers.get("host", ""):
                return error_response(403, "the request comes from another site's page")
            if headers.get("content-type", "").partition(";")[0].strip() != "application/json":
                return error_response(415, "expected a body of type application/json")
        return None


def error_response(status: int, text: str, headers: Mapping[str, str] | None = None) -> JSONResponse:
    return JSONResponse({"error": text}, status, headers)
