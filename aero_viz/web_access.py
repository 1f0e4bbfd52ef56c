"""Requests that our servers answer: those for their own names, from an own or allowed page or from no page at all."""

from __future__ import annotations

import ipaddress
import logging
import re
import socket
from collections.abc import Sequence
from dataclasses import dataclass
from urllib.parse import urlsplit

from websockets import Headers

from aero_viz.errors import UserError

# viser's page unpacks and evaluates its own scripts, and starts workers of them.
_POLICY = (
    "default-src 'self' data: blob: 'unsafe-inline'; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob: data:; "
    "object-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors "
)
_HEADERS = {
    "Cross-Origin-Resource-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
}
_LOOPBACK = ("localhost", "127.0.0.1", "::1")
ANY_ADDRESS = ("", "0.0.0.0", "::")
"""Hosts that stand for all addresses of the machine."""
_PORTS = {"http": 80, "https": 443}


@dataclass(frozen=True)
class Refusal:
    """Why a request is refused."""

    header: str
    """Header that decided: Host, Origin or Sec-Fetch-Site."""
    reason: str
    """One sentence."""
    name: str = ""
    """Name of a host in that header; empty if there is none that can be read."""


class Access:
    """Decides by the headers of a request whether it is answered.

    A browser states the name that it was given (Host) and the page that asks (Origin). The name has to be one that the
    server was started for, so that a foreign name that was pointed at this machine (DNS rebinding) gets nothing. The
    page has to be our own or an allowed one. Pages cannot leave out or forge the origin of a websocket, so that a
    client without one is a program, not a page; it is answered.

    Args:
        host: address that the server listens on.
        allowed_hosts: further names under which browsers reach the server, such as that of a proxy.
        allowed_origins: origins of foreign pages that are answered, such as https://app.foxglove.dev.
        embedders: origins of foreign pages that may show ours in a frame, such as http://localhost:8888 of a notebook.

    Raises:
        UserError: an allowed host is not a name or an address, or an origin is not one.

    Attributes:
        security_headers: headers of every answer: no other foreign page may frame or embed the page, and it loads
            nothing from elsewhere.
        is_local: True if only this machine can reach the address.
        is_private: True if only this machine can reach the page: the address is local, and there is no proxy.
    """

    def __init__(
        self,
        host: str,
        allowed_hosts: Sequence[str] = (),
        allowed_origins: Sequence[str] = (),
        embedders: Sequence[str] = (),
    ) -> None:
        host = _canonical(host)
        self.is_local = host == "localhost" or (_is_address(host) and ipaddress.ip_address(host).is_loopback)
        self._proxies = {_checked(name) for name in allowed_hosts}
        self._origins = {_checked_origin(origin) for origin in allowed_origins}
        # The older header can name no origins; browsers that know frame-ancestors go by that.
        frames = {"X-Frame-Options": "DENY"} if not embedders else {}
        ancestors = " ".join(map(_checked_page, embedders)) or "'none'"
        self.security_headers = {"Content-Security-Policy": _POLICY + ancestors, **frames, **_HEADERS}
        self._is_embedded = bool(embedders)
        self.is_private = self.is_local and not self._proxies
        self._names = {*_LOOPBACK, *self._proxies}
        self._any_address = host in ANY_ADDRESS
        if self._any_address:
            name = socket.gethostname().lower()
            self._names |= {name, f"{name}.local"}
        else:
            self._names.add(host)

    def refusal(self, headers: Headers) -> Refusal | None:
        """Return why a request with these headers is refused, None if it is answered."""
        host = _place(f"//{_only(headers, 'Host') or ''}")
        if host is None or not self._is_known(host[0]):
            name = host[0] if host else ""
            shown = repr(name[:100]) if name else "no readable name"
            return Refusal("Host", f"The request asks for {shown}, a name that this server was not started for.", name)
        written = _only(headers, "Origin")
        origin = None if written is None else _origin(written)
        if origin is not None and origin in self._origins:
            return None
        if written is not None and (origin is None or not self._is_own(origin, host)):
            reason = f"The request comes from the page of another origin, {written[:100]!r}, and asks for {host[0]!r}."
            return Refusal("Origin", reason, origin[1] if origin else "")
        if not _is_own_navigation(headers, in_frames=self._is_embedded):
            return Refusal("Sec-Fetch-Site", "The request was made by a page of another site.")
        return None

    @property
    def proxies(self) -> list[str]:
        """Names of proxies, as browsers reach them."""
        return sorted(self._proxies)

    def _is_known(self, name: str) -> bool:
        return name in self._names or (self._any_address and _is_address(name))

    def _is_own(self, origin: tuple[str, str, int | None], host: tuple[str, int | None]) -> bool:
        """Return True if `origin` is the page at `host`, or a page that an allowed proxy serves."""
        scheme, name, port = origin
        return scheme in _PORTS and (name in self._proxies or (name, port) == (host[0], host[1] or _PORTS[scheme]))


def is_encrypted(headers: Headers) -> bool:
    """Return True if a browser made a request through TLS, which ends at a proxy.

    Proxies say so in a header. Browsers send Sec-Fetch-Site only through TLS, and to this machine.
    """
    proto = (_only(headers, "X-Forwarded-Proto") or "").split(",")[0].strip().lower()
    if proto:
        return proto == "https"
    if "proto=https" in (_only(headers, "Forwarded") or "").lower():
        return True
    host = _place(f"//{_only(headers, 'Host') or ''}")
    return "Sec-Fetch-Site" in headers and host is not None and host[0] not in _LOOPBACK


def _only(headers: Headers, name: str) -> str | None:
    """Return the value of a header: None if it is missing, empty if it was sent more than once."""
    values = headers.get_all(name)
    return values[0] if len(values) == 1 else "" if values else None


def _place(address: str) -> tuple[str, int | None] | None:
    """Return the name and the port of an address, None if it has no name or cannot be read."""
    try:
        parts = urlsplit(address)
        name, port = parts.hostname, parts.port
    except ValueError:
        return None
    if not name or "@" in parts.netloc or parts.path or parts.query or parts.fragment:
        return None
    return _canonical(name), port


def _origin(text: str) -> tuple[str, str, int | None] | None:
    """Return scheme, name and port of an origin, None if it has no scheme or cannot be read, as "null"."""
    scheme, separator, rest = text.lower().partition("://")
    if scheme == "file" and separator and not rest:  # desktop applications; browsers send "null" for a file
        return "file", "", None
    place = _place(f"//{rest}") if scheme and separator else None
    return None if place is None else (scheme, place[0], place[1] or _PORTS.get(scheme))


def _canonical(name: str) -> str:
    """Return an address as browsers write it, or a name in lower case without a final dot."""
    try:
        return ipaddress.ip_address(name).compressed
    except ValueError:
        return name.lower().rstrip(".")


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _is_own_navigation(headers: Headers, *, in_frames: bool) -> bool:
    """Return False if the browser says that a page of another site asks, except for a link that opens our page.

    With `in_frames`, it may open in a frame, too: the answer tells the browser in which pages.
    """
    if (_only(headers, "Sec-Fetch-Site") or "none") in ("none", "same-origin"):
        return True
    shown = ("document", "iframe") if in_frames else ("document",)
    return _only(headers, "Sec-Fetch-Mode") == "navigate" and _only(headers, "Sec-Fetch-Dest") in shown


def _checked(name: str) -> str:
    place = _place(f"//[{name}]" if name.count(":") > 1 and "[" not in name else f"//{name}")
    if place is None or place[1] is not None:
        raise UserError(f"{name!r} is not the name of a host; give --allow-host a name such as viz.example.org.")
    return place[0]


def _checked_origin(text: str) -> tuple[str, str, int | None]:
    origin = _origin(text)
    if origin is None or "*" in text:
        raise UserError(
            f"{text!r} is not the origin of a page, such as https://viz.example.org or http://localhost:8080."
        )
    return origin


def _checked_page(text: str) -> str:
    """Return the origin of a web page as browsers write it."""
    scheme, name, port = _checked_origin(text)
    if scheme not in _PORTS or re.fullmatch(r"[\w.-]+|[0-9a-f:]+", name) is None:
        raise UserError(f"{text!r} is not the origin of a web page, such as http://localhost:8888.")
    return f"{scheme}://{f'[{name}]' if ':' in name else name}{'' if port == _PORTS[scheme] else f':{port}'}"


def local_address(host: str, port: int) -> str:
    """Return host and port as in a URL that opens a server on this machine."""
    host = {"": "127.0.0.1", "0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
    return f"{f'[{host}]' if ':' in host else host}:{port}"


def quiet_logger(name: str) -> logging.Logger:
    """Return a logger for `websockets` that spends one line on a failed connection, which anyone can cause."""
    logger = logging.getLogger(f"{name}.websockets")
    logger.addFilter(_shorten)
    return logger


def _shorten(record: logging.LogRecord) -> bool:
    if record.getMessage() == "opening handshake failed":  # whatever is not HTTP, such as a port scan
        return False
    if record.exc_info:
        record.msg, record.args, record.exc_info = f"{record.getMessage()}: {record.exc_info[1]!r}", (), None
    return True
