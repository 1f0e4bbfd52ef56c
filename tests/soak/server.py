"""The server of a soak: flies scene after scene, shows them on the page, and answers how it is doing."""

import json
import sys
import threading
import time

from aero_viz.catalog import open_source
from aero_viz.dashboard import Dashboard
from aero_viz.session import Session

_SCENES = ("forest", "inclines", "verticals")


class Demo:
    """Flies one scene after the other, changes a parameter before each, and counts ticks."""

    def __init__(self, session: Session) -> None:
        self.flights = self.ticks = 0
        self._session = session
        self._played = 0.0
        self._since: float | None = None
        self._lock = threading.Lock()
        session.subscribe(self._count, every=True, name="soak")
        session.subscribe_playing(self._switch)

    @property
    def played(self) -> float:
        """Time for which the session has played [s]."""
        with self._lock:
            return self._played + (0.0 if self._since is None else time.monotonic() - self._since)

    def fly(self) -> None:
        """Open another scene whenever a flight has ended, for ever."""
        while True:
            time.sleep(1.0)
            frame = self._session.frame
            if frame is None or frame.outcome is None or self._session.playing:
                continue
            self.flights += 1
            scene = _SCENES[self.flights % len(_SCENES)]
            self._session.set_source(open_source(scene, seed=self.flights)).result()
            self._session.configure({"costs.q_position": 2.0 + self.flights % 5})
            self._session.play()

    def _count(self, _: object) -> None:
        self.ticks += 1

    def _switch(self, playing: bool) -> None:
        with self._lock:
            now = time.monotonic()
            self._played += 0.0 if self._since is None else now - self._since
            self._since = now if playing else None


def main() -> None:
    """Serve until standard input ends. Each line of it is answered with the figures so far."""
    session = Session(open_source(_SCENES[0], seed=0))
    demo = Demo(session)
    dashboard = Dashboard(session, port=0)
    session.start()
    threading.Thread(target=demo.fly, daemon=True).start()
    print(json.dumps(dashboard.url), flush=True)
    for _ in sys.stdin:
        clients, frame = len(dashboard.server.get_clients()), session.frame
        figures = {"ticks": demo.ticks, "played": demo.played, "flights": demo.flights, "clients": clients}
        figures["time"] = 0.0 if frame is None else frame.time
        print(json.dumps(figures), flush=True)
    dashboard.close()
    session.close()


if __name__ == "__main__":
    main()
