"""The page that explains why a request is refused, and what to change, for whoever sets up a proxy."""

from __future__ import annotations

import functools
import gzip
import html
from urllib.parse import parse_qsl, urlsplit

from websockets import Headers, Response

from aero_viz.web_access import Access, Refusal

_QUERY = "aero-origin"
_SCRIPT = f"""<script>
addEventListener("load", async () => {{
  const answer = await fetch("?{_QUERY}=" + encodeURIComponent(location.origin)).catch(() => null);
  if (answer?.status !== 403) return;
  const page = await answer.text();
  document.open();
  document.write(page);
  document.close();
}});
</script>"""
"""Script that replaces the page by an explanation where a proxy has changed the name that the server is asked for.

The websocket of the page would be refused, and a page cannot read why. The request of the page itself has no origin.
"""
_PAGE = """<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>AERO-Viz: refused</title><style>:root{{color-scheme:light dark}}
body{{font:16px/1.5 system-ui,sans-serif;max-width:44em;margin:3em auto;padding:0 1em}}
code{{font-size:.95em;background:#8883;padding:.1em .3em;border-radius:3px;overflow-wrap:anywhere}}
li{{margin:.6em 0}}</style><h1>AERO-Viz does not answer this address</h1><p>{reason}</p><ul>{advice}</ul></html>
"""


def refusal_page(refusal: Refusal) -> str:
    """Return the page that explains a refusal."""
    advice = "".join(f"<li>{line}</li>" for line in _ADVICE[refusal.header](refusal))
    return _PAGE.format(reason=html.escape(refusal.reason), advice=advice)


def page_origin(path: str) -> str | None:
    """Return the origin at which the page finds itself, if a request asks whether its websocket would be answered."""
    try:
        return dict(parse_qsl(urlsplit(path).query, max_num_fields=2)).get(_QUERY)
    except ValueError:
        return None


def refusal_of(access: Access, origin: str, headers: Headers) -> Refusal | None:
    """Return why a websocket of a page at `origin` would be refused, None if it would be answered."""
    asked = Headers([("Origin", origin), *(("Host", host) for host in headers.get_all("Host"))])
    return access.refusal(asked)


def add_check(response: Response) -> None:
    """Let a page of viser find out whether its websocket will be answered."""
    encoding = response.headers.get("Content-Encoding", "")
    if response.status_code == 200 and response.headers.get("Content-Type", "").startswith("text/html"):
        response.body = _checking(bytes(response.body), encoding)
        del response.headers["Content-Length"]
        response.headers["Content-Length"] = str(len(response.body))


@functools.lru_cache(maxsize=2)
def _checking(page: bytes, encoding: str) -> bytes:
    """Return a page with the script; once per form of the page, since compression takes a while."""
    plain = gzip.decompress(page) if encoding == "gzip" else page
    plain = plain.replace(b"<head>", b"<head>" + _SCRIPT.encode(), 1)
    return gzip.compress(plain, 6) if encoding == "gzip" else plain


def _code(text: str) -> str:
    return f"<code>{html.escape(text)}</code>"


def _host(refusal: Refusal) -> list[str]:
    name = refusal.name or "NAME"
    return [
        f"If {_code(name)} is in the address bar, start AERO-Viz again with {_code(f'--allow-host {name}')}, where it "
        "is the name of a proxy, or with <code>--host</code>, where it is one of this machine.",
        "If another name is in the address bar, a proxy replaces the header Host. Let it pass on what the browser "
        "sends: nginx needs <code>proxy_set_header Host $http_host;</code>. Caddy does so unless "
        "<code>header_up Host</code> says otherwise.",
    ]


def _origin(refusal: Refusal) -> list[str]:
    name = refusal.name or "NAME"
    return [
        f"If {_code(name)} is in the address bar, start AERO-Viz again with {_code(f'--allow-host {name}')}: a proxy "
        "asks for another name than the browser does. It may also pass the name on: nginx needs "
        "<code>proxy_set_header Host $http_host;</code>.",
        "If another name is in the address bar, a proxy replaces the header Origin. Remove "
        "<code>proxy_set_header Origin</code> (nginx) or <code>header_up Origin</code> (Caddy).",
    ]


def _site(refusal: Refusal) -> list[str]:
    return [
        "To show AERO-Viz in a frame of another page, start it again with <code>--embed</code> and the origin of that "
        "page, such as <code>--embed http://localhost:8888</code> for a notebook.",
        "Otherwise, open its address in a window of its own.",
    ]


_ADVICE = {"Host": _host, "Origin": _origin, "Sec-Fetch-Site": _site}
