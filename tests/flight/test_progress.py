from __future__ import annotations

import io

from aero_viz.flight import ProgressBar


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_terminal_shows_the_last_state_on_one_line():
    terminal = Terminal()
    bar = ProgressBar("forest", stream=terminal)
    for finished in range(3):
        bar(finished, 2, 0.5 * finished)
    shown = terminal.getvalue().split("\r\x1b[K")
    assert shown[1].startswith("forest [........................] 0/2 flights, 0.0 s flown")
    assert shown[-1].startswith("forest [########################] 2/2 flights, 1.0 s flown")
    assert shown[-1].endswith("\n") and terminal.getvalue().count("\n") == 1


def test_a_file_shows_nothing():
    file = io.StringIO()
    ProgressBar(stream=file)(1, 2, 0.0)
    assert file.getvalue() == ""
