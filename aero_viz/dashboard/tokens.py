"""The secret links of a page that other machines can reach: one to control the session, one to watch it."""

from __future__ import annotations

import enum
import secrets
from urllib.parse import parse_qsl, urlencode, urlsplit

from websockets import Headers

from aero_viz.dashboard.links import MOST_ENTRIES


class Role(enum.Enum):
    """Role that a link gives."""

    CONTROL = "control"
    VIEW = "view"


class Tokens:
    """Two random tokens, new at every start.

    A link carries its token in the query. The answer to it moves the token to a cookie, so that it does not stay in the
    address, which others see and which browsers keep and pass on. Programs may leave it in the query.

    Args:
        port: port of the server, since all ports of a machine share their cookies.
    """

    def __init__(self, port: int) -> None:
        self._values = {role: secrets.token_urlsafe(24) for role in Role}
        self._cookie = f"aero_viz_{port}"

    def query(self, role: Role) -> str:
        """Return the part of a role's link after the address."""
        return f"/?token={self._values[role]}"

    def role(self, path: str, headers: Headers) -> Role | None:
        """Return the role by the token in a request's query or, without one, in its cookie; None without a valid
        token."""
        given = self._in_query(path)
        return self._role(self._in_cookies(headers) if given is None else given)

    def cookie(self, path: str, *, is_encrypted: bool) -> str | None:
        """Return the header that makes a browser keep the token in the query; None if there is no valid one.

        Args:
            path: path of the request.
            is_encrypted: True if the browser asks through TLS; it then sends the cookie through nothing else.
        """
        role = self._role(self._in_query(path))
        if role is None:
            return None
        secure = "; Secure" if is_encrypted else ""
        return f"{self._cookie}={self._values[role]}; Path=/; HttpOnly; SameSite=Lax{secure}"

    def without_token(self, path: str) -> str:
        """Return the query of a path without its token, with a leading "?" unless nothing is left.

        Raises:
            ValueError: the query has too many entries.
        """
        left = [(name, value) for name, value in _entries(path) if name != "token"]
        return "?" + urlencode(left, safe="/") if left else ""

    def _role(self, given: str | None) -> Role | None:
        found = None
        for role, value in self._values.items():  # both, so that the time does not depend on what was given
            if secrets.compare_digest((given or "").encode(errors="replace"), value.encode()):
                found = role
        return found

    def _in_query(self, path: str) -> str | None:
        """Return the token in a query, empty if it is given twice; None if there is none."""
        try:
            given = [value for name, value in _entries(path) if name == "token"]
        except ValueError:
            return ""
        return given[0] if len(given) == 1 else "" if given else None

    def _in_cookies(self, headers: Headers) -> str | None:
        pairs = [pair.strip().partition("=") for line in headers.get_all("Cookie") for pair in line.split(";")]
        given = [value for name, _, value in pairs if name == self._cookie]
        return given[0] if len(given) == 1 else None


def _entries(path: str) -> list[tuple[str, str]]:
    return parse_qsl(urlsplit(path).query, keep_blank_values=True, max_num_fields=MOST_ENTRIES)
