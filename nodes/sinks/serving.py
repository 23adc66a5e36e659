"""Who may see what the viewer and the web page serve: under which names they are called, and who has the token.

A picture of people is not for everybody with a login: any user of the machine can connect to its loopback ports, and
any page in a browser can, once its own name is made to lead here (DNS rebinding). So poses need a token, and no request
is answered that names another host.
"""

from __future__ import annotations

import hmac
import ipaddress
import socket
from collections.abc import Collection
from urllib.parse import urlsplit

LOCAL_NAMES = ("localhost", "127.0.0.1", "::1")
"""hosts that only this machine reaches"""


def own_names(host: str, *others: str) -> frozenset[str]:
    """The names of a server at ``host``: this machine's, and others that lead here."""
    return frozenset(name.lower() for name in ("localhost", host, socket.gethostname(), *others))


def called(header: str | None, names: Collection[str]) -> str | None:
    """The host and port of a request's ``Host``, if they are this machine: an address, which leads where it says, or
    one of ``names``; else None."""
    try:
        parts = urlsplit(f"//{header or ''}")
        name, port = parts.hostname or "", parts.port or 80
    except ValueError:
        return None
    if name not in names:
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return None
    return f"{in_url(name)}:{port}"


def is_token(given: str, token: str) -> bool:
    """Compares in a time that does not tell how much of it is right."""
    return hmac.compare_digest(given.encode(), token.encode())


def shown(host: str) -> str:
    """A host as it stands in a printed address: this machine's name for all its addresses."""
    try:
        return socket.gethostname() if ipaddress.ip_address(host).is_unspecified else in_url(host)
    except ValueError:
        return host


def in_url(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def port_taken(section: str, host: str, port: int, error: OSError) -> str:
    """What to say of a port that cannot be opened."""
    return (
        f"[{section}] port {port} at {host} is not to be had ({error.strerror}): another one may be running; close it, "
        f"or set another [{section}] port"
    )
