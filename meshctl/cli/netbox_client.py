"""NetBox's REST API through pynetbox, the extra `netbox`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from meshctl.errors import InputError, Unreachable

if TYPE_CHECKING:
    import pynetbox
    import requests

INSTALL_HINT = "install it with: pip install 'meshctl-fleet[netbox]'"
TIMEOUT_S = 60.0
"""Without a byte; a busy NetBox takes seconds for a page of a thousand devices."""
# names an interface query may list; a longer list would exceed the length of a URL
_DEVICES_PER_QUERY = 50
_HINTS = {
    401: "check NETBOX_TOKEN",
    403: "check NETBOX_TOKEN and its permissions",
    404: "give the address of NetBox's start page, without /api",
    429: "try again later",
}


def fetch(
    url: str, token: str, filters: Mapping[str, Sequence[str]], *, timeout_s: float = TIMEOUT_S
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """The devices that match, and their interfaces, as JSON records.

    Raises InputError without pynetbox, without a token, or for an answer that is an error; Unreachable without one.
    """
    try:
        import pynetbox
        import requests
    except ImportError as error:
        raise InputError(f"NetBox needs {error.name}, which is not installed", hint=INSTALL_HINT) from None
    if not url.startswith(("http://", "https://")):
        raise InputError(f"{url}: expected a URL, such as https://netbox.example.org")
    if not token:
        raise InputError("NETBOX_TOKEN is not set", hint="create an API token in NetBox and export it")
    api = pynetbox.api(url, token=token)
    api.http_session = _session(timeout_s)
    try:
        devices = _records(api, url, "devices", filters)
        numbers = [device["id"] for device in devices]
        interfaces: list[dict[str, Any]] = []
        for start in range(0, len(numbers), _DEVICES_PER_QUERY):
            query = {"device_id": numbers[start : start + _DEVICES_PER_QUERY]}
            interfaces += _records(api, url, "interfaces", query)
    except pynetbox.RequestError as error:
        status = error.req.status_code
        hint = _HINTS.get(status, "check the log of NetBox, or of the proxy in front of it")
        raise InputError(f"{url}: NetBox refused the request: {_reason(error)}", hint=hint) from error
    except pynetbox.ContentError as error:
        raise InputError(f"{url}: the answer is not JSON: is this NetBox?") from error
    except requests.exceptions.RequestException as error:
        asked = "" if error.request is None else str(error.request.url or "")
        where = (
            "" if not asked or asked.startswith(url) else f" from {asked.partition('?')[0]}, to which {url} redirected"
        )
        reason = next((text for kind, text in _failures(timeout_s) if isinstance(error, kind)), type(error).__name__)
        hint = "check the address, and open it in a browser on this computer"
        raise Unreachable(f"{url}: no answer{where}: {reason}", hint=hint) from error
    return devices, interfaces


def _failures(timeout_s: float) -> tuple[tuple[type[Exception], str], ...]:
    """What the errors of requests mean; a subclass stands before its base class."""
    from requests import exceptions

    return (
        (exceptions.SSLError, "its certificate is not trusted on this computer"),
        (exceptions.ConnectTimeout, f"cannot connect within {timeout_s:g} s"),
        (exceptions.Timeout, f"nothing within {timeout_s:g} s"),
        (exceptions.ConnectionError, "cannot connect, or the connection broke"),
    )


def _session(timeout_s: float) -> requests.Session:
    import requests
    from requests.adapters import HTTPAdapter

    class Adapter(HTTPAdapter):
        def send(self, request: Any, stream: Any = False, timeout: Any = None, *others: Any, **named: Any) -> Any:
            return super().send(request, stream, timeout or timeout_s, *others, **named)

    session = requests.Session()
    for scheme in ("http://", "https://"):
        session.mount(scheme, Adapter())
    return session


def _records(
    api: pynetbox.core.api.Api, url: str, kind: str, filters: Mapping[str, Sequence[object]]
) -> list[dict[str, Any]]:
    """All pages of a list as NetBox wrote them; pynetbox's own records require that NetBox knows the URL it is asked
    by, which it often does not behind a proxy."""
    from pynetbox.core.query import Request

    query = Request(f"{api.base_url}/dcim/{kind}", api.http_session, filters=dict(filters), limit=0, token=api.token)
    found: dict[int, dict[str, Any]] = {}
    try:
        for number, record in enumerate(query.get(), 1):
            if number > query.count:
                raise InputError(f"{url}: more {kind} than NetBox counted, {query.count}: repeat the command")
            found[record["id"]] = record
    except (AttributeError, KeyError, TypeError) as error:
        raise InputError(f"{url}: expected a list of {kind}, found something else: is this NetBox?") from error
    if not all(isinstance(number, int) for number in found):
        raise InputError(f"{url}: expected {kind} with a number as their id: is this NetBox?")
    return list(found.values())


def _reason(error: pynetbox.RequestError) -> str:
    """The status, and NetBox's own words if it has any."""
    try:
        answer = error.req.json()
    except ValueError:
        answer = None
    detail = answer.get("detail") or answer.get("error") if isinstance(answer, dict) else None
    return f"{error.req.status_code} {error.req.reason}" + (f": {detail}" if detail else "")
