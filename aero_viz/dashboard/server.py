"""The web server of the page: its address, its appearance, and the requests that it refuses."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import functools
import io
import logging
import socket
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Any

import viser
from websockets import Request, Response
from websockets.asyncio.server import ServerConnection

from aero_viz.dashboard import accessibility, hidden_tab, palette, viser_private
from aero_viz.dashboard.connection import MESSAGE_MAX, PageConnection
from aero_viz.dashboard.number_fields import NumberFields
from aero_viz.dashboard.page_messages import PageMessage
from aero_viz.dashboard.refusal_page import add_check, page_origin, refusal_of, refusal_page
from aero_viz.dashboard.scene_style import style_scene
from aero_viz.dashboard.tokens import Role, Tokens
from aero_viz.dashboard.visitors import Visitors
from aero_viz.errors import UserError
from aero_viz.guests import BACKLOG, Guests, report_briefly
from aero_viz.session.base import completed
from aero_viz.web_access import ANY_ADDRESS, Access, Refusal, is_encrypted, local_address, quiet_logger

UPLOAD_LIMIT = 256_000
"""Size of the largest file that a page may upload [bytes]. A file with every parameter takes 8 kB."""
_QUEUED_FRAMES = 2
"""Largest number of pending messages of a client."""

_INPUT = ":is(.mantine-NumberInput-root,.mantine-Checkbox-root)"
_SECTION = '.mantine-Tabs-root[style*="border-top"]'
_SHEET = '.mantine-Paper-root[style*="max-height: 60%"]'
_STYLE = "".join(
    (
        ':root[data-mantine-color-scheme="dark"]{',
        *(f"--mantine-color-dark-{shade}:{palette.css(color)};" for shade, color in palette.PANEL.items()),
        "--mantine-color-body:var(--mantine-color-dark-7)!important}",
        # Colours of curves are chosen for a dark ground.
        f':root[data-mantine-color-scheme="light"] .aero-plot{{background:{palette.css(palette.PANEL[6])}!important}}',
        ':root[data-mantine-color-scheme="light"] :is(canvas[data-engine],.aero-scene)'
        f"{{filter:{palette.TURNED_OVER}}}",
        # Room for the number 100000 next to a slider.
        '[style*="3rem"]>div>.mantine-NumberInput-input{padding-inline:2px!important}',
        # Everything below the playback controls scrolls separately, so that these stay in view.
        ".mantine-ScrollArea-content div:has(>[role=tab])+div"
        "{max-height:calc(100vh - 19rem - var(--aero-visitors,0rem));overflow-y:auto!important;overflow-x:hidden}",
        # The line about the visitors, and the button that takes control.
        ".mantine-ScrollArea-content:has(.aero-visitors){--aero-visitors:3rem}",
        ".mantine-ScrollArea-content:has(.aero-take-control){--aero-visitors:5rem}",
        # The thumb at an end of a slider leaves the number below it visible.
        ".mantine-Slider-markLabel{translate:0 0.2rem}",
        # All tabs fit in one row without their icons.
        ".mantine-ScrollArea-content [role=tab]>:has(svg){display:none!important}",
        ".mantine-ScrollArea-content [role=tab]{padding:0 0.8em!important;min-height:2.3em!important}",
        # A number or a checkbox needs little room, its label much.
        f".mantine-Flex-root:has(>div>{_INPUT},>div>div>{_INPUT})>div:first-child{{width:13em!important}}",
        # The floating panel stays beside the docked one. On a phone, the controls are a sheet below the drone.
        '.mantine-Paper-root[style*="position: absolute"]{max-width:calc(100vw - 384px)}',
        f"@media(max-width:36em){{{_SHEET}{{width:100%!important;max-height:40%!important}}"
        '.mantine-ScrollArea-content>[style="width: 20em;"]{width:100%!important}'
        # The status is a section of that sheet, which viser puts below all controls: it comes first instead.
        f":has(>div>{_SECTION}){{display:flex;flex-direction:column}}:has(>{_SECTION}){{order:-1}}"
        # While the sheet is open, the scene fills the rest of the page, so that the drone is in its middle.
        f"body:has({_SHEET} .mantine-ScrollArea-content>div>[aria-hidden=false])"
        " div:has(>div>div>div>canvas[data-engine]){bottom:40%!important}}",
        # A slider without a label belongs to the number field above it: it takes the whole row and has no number.
        "div:has(>.mantine-Text-root>label:empty){display:none}",
        "div:has(>.mantine-Flex-root>div>.mantine-Text-root>label:empty){padding-bottom:1.1em!important}",
        "div:has(>.mantine-Text-root>label:empty)+div .mantine-NumberInput-root{display:none}",
        # A parameter that differs from the preset; an element before it tells so.
        f"div:has(>.aero-changed)+div{{box-shadow:inset 3px 0 {palette.css(palette.WARNING)};"
        f"background:{palette.css(palette.WARNING, 0.10)}}}",
        ".aero-copy{float:right;font-size:11px;padding:0 8px;border:1px solid;border-radius:4px;background:none;"
        "color:inherit;cursor:pointer}",
        # Shared controls look disabled to whoever only watches; the buttons of the camera are each visitor's own.
        ".mantine-ScrollArea-content:has(.aero-watching)"
        " :is(.mantine-Button-root,.mantine-Slider-root,.mantine-NumberInput-controls,input)"
        "{opacity:.4;cursor:not-allowed}",
        "div:has(>[class^=aero-camera-])+div .mantine-Button-root{opacity:1!important;cursor:pointer!important}",
        # The active one of a group of buttons; an element before the group tells its number.
        *(
            f"div:has(>.aero-camera-{i})+div .mantine-Button-root:nth-child({i})"
            f"{{background:{palette.css(palette.BRAND)};color:#fff}}"
            for i in range(1, 5)
        ),
    )
)
"""Style sheet of the page, for the elements of Mantine that viser builds its controls from."""
_log = logging.getLogger(__name__)
_NOTIFICATIONS: dict[str, tuple[str, Any, float]] = {
    "info": ("AERO-Viz", "blue", 5.0),
    "failure": ("The flight failed", "red", 12.0),
    "error": ("Error", "red", 12.0),
}
"""Title, colour and duration [s] of a notification by level."""
_FULL = "Too many pages are open; close one first."
_NO_TOKEN = "This page needs a link with a token; the terminal in which AERO-Viz was started shows it."
REFUSAL = "Sharing through a public tunnel is refused; to reach the page from another machine, start it with --host."


class LocalServer(viser.ViserServer):
    """A viser server on exactly the requested address, for its own page only, without public tunnels.

    viser serves every name and every origin, trusts its clients, and can lose the wake-up that sends a message. Its
    server is therefore started with the connection handling below. viser has no parameter for that.

    Args:
        host: address to listen on.
        port: port to listen on; 0 takes any free one.
        allowed_hosts: names under which browsers reach the server besides `host`, such as that of a proxy.
        embedders: origins of foreign pages that may show the page in a frame.
        upload_limit: size of the largest file that a page may upload [bytes].

    Raises:
        UserError: the port is taken, the host is not an address of this machine, or a name or an origin is none.
    """

    def __init__(
        self,
        *,
        host: str = "127.0.0.1",
        port: int = 8080,
        allowed_hosts: Sequence[str] = (),
        embedders: Sequence[str] = (),
        upload_limit: int = UPLOAD_LIMIT,
    ) -> None:
        self.catch_up: Callable[[], Future[Any]] = completed
        """Returns a future that is done when every earlier request of the page has been carried out; set by the
        dashboard."""
        self._access = Access(host, allowed_hosts, embedders=embedders)
        self.visitors = Visitors()
        """Visitors of the page."""
        self.number_fields = NumberFields()
        """The fields that they type in."""
        self.answers: dict[type[PageMessage], Callable[[viser.ClientHandle, Any], object]] = {}
        """What to do with messages of the page that viser does not know, by their type."""
        self._tokens: Tokens | None = None
        """Links that are required; None if only this machine can reach the page."""
        self._is_open = threading.Event()
        self.guests = Guests(is_proxied=bool(self._access.proxies))
        """Connections to the server."""
        _require_free(host, port)
        options = {
            "create_connection": functools.partial(
                PageConnection,
                guests=self.guests,
                page=self,
                visitors=self.visitors,
                number_fields=self.number_fields,
                answers=self.answers,
                upload_limit=upload_limit,
                catch_up=lambda: self.catch_up(),
            ),
            "process_response": self._complete,
            "max_queue": _QUEUED_FRAMES,
            "max_size": MESSAGE_MAX,
            "backlog": BACKLOG,
            "logger": quiet_logger(__name__),
        }
        # viser's banner is discarded; the caller prints the address.
        with contextlib.redirect_stdout(io.StringIO()), viser_private.serving(self._admit, options):
            super().__init__(host=host, port=port, label="AERO-Viz", verbose=False)
        if port and self.get_port() != port:
            self.stop()
            raise _busy(host, port)
        report_briefly(self.get_event_loop())
        viser_private.mend(self, on_leave=self._forget)
        if not self._access.is_private:
            self._tokens = Tokens(self.get_port())
        self._style()
        self._is_open.set()

    async def _admit(self, connection: PageConnection, request: Request) -> Response | None:
        """Return the answer to a request that is refused, None for one that viser answers."""
        while not self._is_open.is_set():  # viser listens before its own constructor has ended
            await asyncio.sleep(0.01)
        refusal = self._access.refusal(request.headers)
        if refusal is not None:
            return _refused(connection, request, refusal)
        if (origin := page_origin(request.path)) is not None and "Upgrade" not in request.headers:
            refusal = refusal_of(self._access, origin, request.headers)
            return connection.respond(204, "") if refusal is None else _refused(connection, request, refusal)
        answer = None if self._tokens is None else self._check_token(self._tokens, connection, request)
        if answer is not None or "Upgrade" not in request.headers:
            return answer
        connection.limit_messages()
        if not self.guests.admit(connection, has_right=connection.role is Role.CONTROL):
            return connection.respond(503, f"{_FULL}\n")
        return None

    def _complete(self, _: ServerConnection, request: Request, response: Response) -> None:
        """Add the security headers to an answer, and the check of its address to the page."""
        add_check(response)
        for name, value in self._access.security_headers.items():
            response.headers[name] = value

    def _check_token(self, tokens: Tokens, connection: PageConnection, request: Request) -> Response | None:
        """Answer links and requests without a valid token; record the role of all other requests."""
        role = tokens.role(request.path, request.headers)
        if role is None:
            return connection.respond(401, f"{_NO_TOKEN}\n")
        connection.role = role
        cookie = tokens.cookie(request.path, is_encrypted=is_encrypted(request.headers))
        if cookie is None or "Upgrade" in request.headers:
            return None
        response = connection.respond(303, "")
        rest = tokens.without_token(request.path)
        # Behind a proxy, only the browser knows the path; the page removes a lone "?" from its address.
        response.headers["Location"] = (rest or "?") if self._access.proxies else f"./{rest}"
        response.headers["Set-Cookie"] = cookie
        return response

    def rendering(self, client: viser.ClientHandle) -> contextlib.AbstractContextManager[None]:
        """Let a client send a picture while the context is open."""
        connection = viser_private.connections(self).get(client.client_id)
        return connection.rendering() if isinstance(connection, PageConnection) else contextlib.nullcontext()

    def _forget(self, client: int) -> None:
        self.visitors.leave(client)
        self.number_fields.leave(client)

    def hide_upload(self, client: viser.ClientHandle) -> None:
        """Remove the notification that a client's last upload was successful, since its file is refused."""
        connection = viser_private.connections(self).get(client.client_id)
        if isinstance(connection, PageConnection):
            connection.hide_upload()

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{local_address(self.get_host(), self.get_port())}"

    def link(self, *, address: str | None = None, view_only: bool = False) -> str:
        """Return the link that opens the page, with a token if one is required.

        Args:
            address: address of the page for others, such as https://viz.example.org; None is the one for this machine.
            view_only: return the link that cannot control the session. There is none if no token is required.
        """
        address = address or self.url
        if self._tokens is None:
            return address
        return address + self._tokens.query(Role.VIEW if view_only else Role.CONTROL)

    @property
    def addresses(self) -> list[str]:
        """Addresses of the page for other machines."""
        host = self.get_host()
        if host in ANY_ADDRESS:
            host = _outward_address()
        own = [] if self._access.is_local else [f"http://{local_address(host, self.get_port())}"]
        return [*own, *(f"https://{name}" for name in self._access.proxies)]

    @property
    def is_private(self) -> bool:
        """True if only this machine can reach the page, so that no token is required."""
        return self._access.is_private

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Refuse to open a public tunnel.

        Any client could request one, which would put the page on the internet.
        """
        _log.warning(REFUSAL)
        notify(self, REFUSAL, level="error")
        return None

    def stop(self) -> None:
        """Stop the server."""
        with contextlib.redirect_stdout(io.StringIO()):
            super().stop()

    def _style(self) -> None:
        viser_private.run_script(self, viser_private.SENDER)
        viser_private.run_script(self, hidden_tab.SCRIPT)
        self.gui.add_html(f"<style>{_STYLE}{accessibility.STYLE}</style>")
        configure_theme(self.gui)
        scene = self.scene
        style_scene(scene)
        scene.configure_environment_map(None)
        scene.configure_default_lights(False)
        scene.world_axes.visible = False
        self.initial_camera.near, self.initial_camera.far = 0.05, 500.0


def _refused(connection: ServerConnection, request: Request, refusal: Refusal) -> Response:
    """Return an answer that says why a request is refused: a page for a browser, a sentence for a program."""
    is_page = "Upgrade" not in request.headers
    response = connection.respond(403, refusal_page(refusal) if is_page else f"{refusal.reason}\n")
    if is_page:
        del response.headers["Content-Type"]
        response.headers["Content-Type"] = "text/html; charset=utf-8"
    return response


def _outward_address() -> str:
    """Return the address of this machine in the network, or its name if it has none."""
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(("192.0.2.1", 9))  # sends nothing
        return probe.getsockname()[0]
    return socket.gethostname()


def notify(
    server: viser.ViserServer, text: str, *, level: str = "info", client: viser.ClientHandle | None = None
) -> None:
    """Show a notification to `client`, or to everyone; `level` is "info", "failure" or "error"."""
    title, color, seconds = _NOTIFICATIONS[level]
    for number, target in server.get_clients().items():
        if client is None or number == client.client_id:
            target.add_notification(title, text, color=color, auto_close_seconds=seconds)


def configure_theme(gui: viser.GuiApi, *, light: bool = False) -> None:
    """Give the panels of all visitors, or of one, the look of the page."""
    # After the window was as narrow as a phone, viser forgets the width of a panel and takes that of the theme.
    gui.configure_theme(
        dark_mode=not light,
        show_logo=False,
        show_share_button=False,
        brand_color=palette.BRAND,
        control_width="large",
    )


def _require_free(host: str, port: int) -> None:
    if not 0 <= port <= 65535:
        raise UserError(f"The port {port} does not exist; give --port from 0 to 65535; 0 takes any.")
    # viser would silently take the next free port.
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            raise _busy(host, port, error) from error


def _busy(host: str, port: int, error: OSError | None = None) -> UserError:
    if isinstance(error, socket.gaierror) or getattr(error, "errno", None) == errno.EADDRNOTAVAIL:
        return UserError(
            f"{host} is not an address of this machine; choose another one with --host: 127.0.0.1 for this machine "
            "only, 0.0.0.0 for everyone who can reach it."
        )
    reason = getattr(error, "strerror", None) or (str(error) if error else "it is in use")
    return UserError(
        f"Port {port} on {host} is not available ({reason}); choose another one with --port, 0 takes any free one."
    )
