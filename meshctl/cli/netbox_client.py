"""NetBox's REST API through pynetbox, the extra `netbox`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from meshctl.errors import InputError, Unreachable

INSTALL_HINT = "install it with: pip install 'meshctl-fleet[netbox]'"
# names an interface query may list; a longer list would exceed the length of a URL
_DEVICES_PER_QUERY = 50


def fetch(
    url: str, token: str, filters: Mapping[str, Sequence[str]]
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
    try:
        query = api.dcim.devices.filter(**filters) if filters else api.dcim.devices.all()
        devices = [dict(record) for record in query]
        numbers = [device["id"] for device in devices]
        interfaces: list[dict[str, Any]] = []
        for start in range(0, len(numbers), _DEVICES_PER_QUERY):
            found = api.dcim.interfaces.filter(device_id=numbers[start : start + _DEVICES_PER_QUERY])
            interfaces += [dict(record) for record in found]
    except pynetbox.RequestError as error:
        raise InputError(f"{url}: NetBox refused the request: {error}", hint="check the token's permissions") from error
    except pynetbox.ContentError as error:
        raise InputError(f"{url}: the answer is not JSON: is this NetBox?") from error
    except requests.exceptions.RequestException as error:
        raise Unreachable(f"{url}: no answer: {type(error).__name__}") from error
    return devices, interfaces
