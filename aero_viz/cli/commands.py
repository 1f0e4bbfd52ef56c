"""All commands of `aero-viz`. The modules of those that ship are imported only on use, which keeps `--help` fast."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable
from typing import Any

from aero_viz.cli.parser import Command
from aero_viz.errors import UserError
from aero_viz.registry import Registry


def _command(module: str, function: str, summary: str, *, needs: str = "") -> Command:
    def load() -> Callable[..., None]:
        return getattr(importlib.import_module(f"aero_viz.cli.{module}"), function)

    return Command(load, summary, needs)


def _accept(name: str, found: Any) -> Command:
    """Return a `Command`, or that of a function with a docstring."""
    if isinstance(found, Command):
        return found
    if not (inspect.isfunction(found) and found.__doc__):
        raise UserError(f"{name} is not a command; give a function with a docstring, from which tyro makes flags.")
    return Command(lambda: found, inspect.cleandoc(found.__doc__).partition("\n")[0])


_SHIPPED: dict[str, Command | str] = {
    "demo": _command("page", "demo", "Fly a synthetic scene live in the browser."),
    "play": _command("page", "play", "Run the planner on a recording, open loop, live in the browser."),
    "sim": _command("sim", "sim", "Fly what a program of ROS 2 commands, in real time, and judge it."),
    "connect": _command("page", "connect", "Show the live plan of a drone that runs `aero-planner run`."),
    "live": _command("live", "live", "Plan live on the topics of ROS 2, on a sensor, or on a capture."),
    "inspect": _command("recordings", "inspect", "Show what a recording contains and which parts can be played."),
    "compare": _command("compare", "compare", "Compare two flight logs: figures, parameters and conditions."),
    "convert": _command("recordings", "convert", "Write a recording, or a part of it, as ROS 2 MCAP."),
    "fly": _command(
        "flights",
        "fly",
        "Fly through a scene or a world once, as fast as possible, and print the result.",
        needs="aero_viz.flight.single",
    ),
    "score": _command(
        "flights",
        "score",
        "Score a flight of any planner with the simulator's own metrics.",
        needs="aero_viz.evaluation.score",
    ),
    "explain": _command(
        "explain",
        "explain",
        "Explain why a flight did not arrive, from its log or by flying it.",
        needs="aero_viz.explain.post_mortem",
    ),
    "bench": _command(
        "bench",
        "bench",
        "Fly a benchmark and write its tables, plots and report.",
        needs="aero_viz.evaluation.bench.runner",
    ),
    "bench compare": _command("bench", "bench_compare", "Compare runs of a benchmark through the same worlds."),
    "bench worlds": _command(
        "bench",
        "bench_worlds",
        "Fly through all worlds in a folder and write a report.",
        needs="aero_viz.evaluation.bench.runner",
    ),
    "tune": _command(
        "tune",
        "tune",
        "Search for better parameter values by flying, and check them in fresh worlds.",
        needs="aero_viz.evaluation.tune",
    ),
    "snapshot": _command(
        "tools",
        "snapshot",
        "Render a scene or a recording at a given time to a PNG file.",
        needs="aero_viz.dashboard.snapshot",
    ),
    "share": _command(
        "share", "share", "Write a flight to one file: page, video, picture or log.", needs="aero_viz.dashboard.share"
    ),
    "world export": _command("tools", "world_export", "Write a world to a file for other programs."),
    "world info": _command(
        "tools", "world_info", "Describe a world: its obstacles, whether a path exists, and how difficult it is."
    ),
    "export": _command("tools", "export", "Compile all kernels ahead of time for a drone that has no compiler."),
    "parameters": _command("tools", "parameters", "Print a Markdown table of every planner parameter."),
    "doctor": _command("tools", "doctor", "Check this machine and print how to install what is missing."),
}
COMMANDS: Registry[Command] = Registry("command", "aero_viz.commands", _SHIPPED, _accept)
"""All commands by name, in the order of the help text."""
