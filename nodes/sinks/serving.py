"""Access control of the viewer and the web page: accepted host names, and tokens.

Any user of a machine can connect to its loopback ports, and so can any web page in a browser whose host name is made to
resolve to this machine (DNS rebinding). Poses of people therefore require a token, and requests for other host names
are refused.
"""

import hmac
import ipaddress
import socket
from collections.abc import Collection
from urllib.parse import urlsplit

LOCAL_NAMES = ("localhost", "127.0.0.1", "::1")  # host names that only this machine can reach


def own_names(host: str, *others: str) -> frozenset[str]:
    """The names of a server at ``host``: ``host``, this machine's names, and ``others``."""
    return frozenset(name.lower() for name in ("localhost", host, socket.gethostname(), *others))


def called(header: str | None, names: Collection[str]) -> str | None:
    """Host and port of a request's ``Host`` header, if it is an IP address or one of ``names``; otherwise None.

    An IP address is safe, because no DNS is involved.
    """
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
    """Compare tokens in constant time."""
    return hmac.compare_digest(given.encode(), token.encode())


def shown(host: str) -> str:
    """A host for a printed address; an unspecified address (0.0.0.0, ::) becomes this machine's name."""
    try:
        return socket.gethostname() if ipaddress.ip_address(host).is_unspecified else in_url(host)
    except ValueError:
        return host


def in_url(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def port_taken(section: str, host: str, port: int, error: Exception) -> str:
    """The error text for a port that cannot be opened."""
    cause = error.strerror if isinstance(error, OSError) else error
    return f"[{section}] port {port} at {host} cannot be opened ({cause}): close what uses it, or set another port"
