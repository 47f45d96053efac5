"""Orders: what an operator signs, and a worker checks, before a plan is executed at a site. Pure but for the keys.

An order names the run, the plan and the inventory by their hashes, so that a worker executes exactly what the operator
has confirmed. A run is prepared by the worker first and can be ordered once, so an order cannot be replayed, whatever
the gateway's clock says.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime

from meshctl.device.authentication import is_signed_by, sign
from meshctl.device.connection import Credentials, fingerprint_of
from meshctl.device.trust import HostKey, parse_key
from meshctl.errors import InputError, MeshctlError

# In front of what is signed: such a signature is none of an SSH login, whose data starts with a length.
_PURPOSE = b"meshctl-order-1\n"


# By how much the clocks of an operator and of a gateway may differ.
MAX_CLOCK_DIFFERENCE_S = 300.0


class OrderRefused(InputError):
    """An order that a worker does not execute."""


class ClockBehind(MeshctlError):
    """The worker's clock is wrong: whether an order has expired is known once it is right."""


def images_sha256(images: Mapping[str, str]) -> str:
    """The hash of firmware images: paths in the part, and the SHA-256 of each."""
    return hashlib.sha256(json.dumps(dict(images), sort_keys=True).encode()).hexdigest()


def _moment(time_s: float) -> str:
    return datetime.fromtimestamp(time_s, UTC).strftime("%Y-%m-%d %H:%M UTC")


@dataclass(frozen=True, slots=True)
class Order:
    """Execute the plan of `run` at a site. `operator` is `user@host`, for the site's history."""

    fleet: str
    site: str
    run: str
    command: str
    operator: str
    plan_sha256: str
    part_sha256: str
    rate_kb_s: float | None = None
    # set for an order that may wait for its site, by the operator's clock (Unix time)
    signed_s: float = 0.0
    expires_s: float | None = None
    # the hash of the firmware images' paths and hashes, and who may read what the run replaces
    images_sha256: str = ""
    reply_to: str = ""

    def check_time(self, now_s: float) -> None:
        """Raises OrderRefused for an order that has expired, and ClockBehind if that cannot be known."""
        if self.expires_s is None:
            return
        if now_s > self.expires_s:
            raise OrderRefused(
                f"the order expired at {_moment(self.expires_s)}, before the site got it; nothing was changed",
                hint="plan and order it again",
            )
        if now_s < self.signed_s - MAX_CLOCK_DIFFERENCE_S:
            raise ClockBehind(f"the clock here says {_moment(now_s)}, the order was signed at {_moment(self.signed_s)}")


@dataclass(frozen=True, slots=True)
class SignedOrder:
    """`text` is the order as JSON, exactly as signed; `key` is the public key, `TYPE BASE64`."""

    text: str
    key: str
    signature: str


def sign_order(order: Order, credentials: Credentials, accepted: Sequence[str]) -> SignedOrder:
    """Sign with the first of our keys that the worker accepts; `accepted` are fingerprints. Raises InputError."""
    text = json.dumps(asdict(order), sort_keys=True)
    signed = sign(credentials, accepted, _PURPOSE + text.encode())
    if signed is None:
        raise InputError(
            f"site {order.site}: its worker accepts orders signed by {', '.join(accepted) or 'no key'}, and none of "
            "those keys is here",
            hint=f"add a key of yours to operators.ssh_keys, then run `meshctl sites install {order.site}`",
        )
    own, signature = signed
    return SignedOrder(text, f"{own.key_type} {own.base64}", base64.b64encode(signature).decode())


def checked_order(signed: SignedOrder, operators: Iterable[HostKey], *, fleet: str, site: str) -> Order:
    """The order, if one of the operators has signed it for this site. Raises OrderRefused."""
    try:
        key = parse_key(signed.key)
        signature = base64.b64decode(signed.signature, validate=True)
    except (ValueError, binascii.Error) as error:
        raise OrderRefused(f"the order's key or signature is damaged: {error}") from error
    if key not in tuple(operators):
        raise OrderRefused(f"the order is signed by {fingerprint_of(key.blob)}, which is no operator's key at {site}")
    if not is_signed_by(key.key_type, key.blob, _PURPOSE + signed.text.encode(), signature):
        raise OrderRefused("the order's signature is wrong")
    try:
        order = Order(**json.loads(signed.text))
    except (ValueError, TypeError) as error:
        raise OrderRefused(f"the order is damaged: {error}") from error
    if (order.fleet, order.site) != (fleet, site):
        raise OrderRefused(f"the order is for {order.fleet}/{order.site}, this is {fleet}/{site}")
    return order


def operator_keys(text: str) -> tuple[HostKey, ...]:
    """The public keys of an authorized_keys file; lines that are none are left out."""
    found = []
    for line in text.splitlines():
        try:
            found.append(parse_key(line))
        except ValueError:
            continue
    return tuple(found)
