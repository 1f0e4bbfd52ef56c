"""All verbs of `aero-viz`. Their modules are imported only when a verb is used, which keeps `aero-viz --help` fast."""

from __future__ import annotations

import importlib

from aero_viz.cli.parser import Verb


def _verb(module: str, function: str, summary: str) -> Verb:
    return Verb(lambda: getattr(importlib.import_module(f"aero_viz.cli.{module}"), function), summary)


VERBS: dict[str, Verb] = {
    "demo": _verb("page", "demo", "Fly a synthetic scene live in the browser."),
    "play": _verb("page", "play", "Run the planner on a recording, open loop, live in the browser."),
    "connect": _verb("page", "connect", "Show the live plan of a drone that runs `aero-planner run`."),
    "inspect": _verb("recordings", "inspect", "Show what a recording contains and which parts can be played."),
    "compare": _verb("compare", "compare", "Compare two flight logs: figures, parameters and conditions."),
    "convert": _verb("recordings", "convert", "Write a recording, or a part of it, as ROS 2 MCAP."),
    "fly": _verb("flights", "fly", "Fly through a scene or a world once, as fast as possible, and print the result."),
    "score": _verb("flights", "score", "Score a flight of any planner with the simulator's own metrics."),
    "explain": _verb("explain", "explain", "Explain why a flight did not arrive, from its log or by flying it."),
    "bench": _verb("bench", "bench", "Fly a benchmark and write its tables, plots and report."),
    "bench compare": _verb("bench", "bench_compare", "Compare two runs of a benchmark through the same worlds."),
    "bench worlds": _verb("bench", "bench_worlds", "Fly through all worlds in a folder and write a report."),
    "tune": _verb("tune", "tune", "Search for better parameter values by flying, and check them in fresh worlds."),
    "snapshot": _verb("tools", "snapshot", "Render a scene or a recording at a given time to a PNG file."),
    "share": _verb("share", "share", "Write a flight to one file: page, video, picture or log."),
    "world": _verb("tools", "world", "Write a world to a file for other programs."),
    "world info": _verb(
        "tools", "world_info", "Describe a world: its obstacles, whether a path exists, and how difficult it is."
    ),
    "export": _verb("tools", "export", "Compile all kernels ahead of time for a drone that has no compiler."),
    "parameters": _verb("tools", "parameters", "Print a Markdown table of every planner parameter."),
    "doctor": _verb("tools", "doctor", "Check this machine and print how to install what is missing."),
}
"""Verbs by name, in the order of the help text."""
