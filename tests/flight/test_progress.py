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


def test_a_single_flight_shows_its_way_and_leaves_no_trace():
    terminal = Terminal()
    bar = ProgressBar("forest", stream=terminal)
    bar.show_way(0.52, 3.0)
    bar.show_way(0.53, 3.1)  # too soon to be drawn
    bar.close()
    shown = terminal.getvalue().split("\r\x1b[K")
    assert len(shown) == 3 and shown[1].startswith("forest [############............] 52 % of the way, 3.0 s flown")
    assert shown[2] == "" and "\n" not in terminal.getvalue()


def test_nothing_is_cleared_where_nothing_was_drawn():
    file = io.StringIO()
    bar = ProgressBar(stream=file)
    bar.show_way(0.5, 1.0)
    bar.close()
    assert file.getvalue() == ""
