"""Parts shared by the benchmarks: options of their command lines, worlds, and the name of the machine."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from aero_planner import PlannerConfig
from aero_planner.config.file import config_from_name
from aero_planner.warp_init import find_device
from aero_viz.scenes import scene
from aero_viz.scenes.world import World


def make_parser(name: str, description: str | None, *, points: int = 200_000) -> argparse.ArgumentParser:
    """Return the parser of `python -m benchmarks.NAME` with the options that all benchmarks have.

    Args:
        name: module of the benchmark.
        description: its docstring.
        points: default of --points.
    """
    parser = argparse.ArgumentParser(prog=f"python -m benchmarks.{name}", description=description)
    parser.add_argument("--device", default="cpu", help="cpu or cuda:0")
    parser.add_argument("--points", type=positive, default=points, help="points of each cloud")
    return parser


def config_of(preset: str, **sampling: int | None) -> PlannerConfig:
    """Return a preset or configuration file with changed sampling parameters; None leaves one as it is.

    Raises:
        ValueError: there is no such preset or file, or a value is out of bounds.
    """
    changes = {f"sampling.{name}": value for name, value in sampling.items() if value is not None}
    return config_from_name(preset).replace(changes)


def split_change(word: str) -> tuple[str, str]:
    """Return the path and the value of SECTION.KEY=VALUE, both as text.

    Raises:
        ValueError: the word has another form.
    """
    path, equals, text = word.partition("=")
    if not equals:
        raise ValueError(f"{word} is not of the form SECTION.KEY=VALUE.")
    return path, text


def value_of(text: str) -> Any:
    """Return the value of a parameter that a command line states: a truth value, a number or a text."""
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            pass
    return text


def make_world(row: str, seed: int) -> World:
    """Return the world of a row SCENE or SCENE:COUNT."""
    name, _, count = row.partition(":")
    return scene(name, seed=seed, count=int(count) if count else None)


def machine(device: str) -> str:
    """Return the name of the processor behind `device`."""
    warp_device = find_device(device)
    if warp_device.is_cuda:
        return warp_device.name
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            names = {line.partition(":")[2].strip() for line in file if line.startswith("model name")}
    except OSError:
        names = set()
    return ", ".join(sorted(names)) or "CPU"


def run_program(
    program: str, *arguments: object, failure: str, folder: Path | None = None, environment: Mapping[str, str] = {}
) -> Any:
    """Run a Python program in a new process and return the JSON that its last line holds.

    Args:
        program: source text.
        arguments: its arguments.
        failure: begin of the error's message.
        folder: working folder; None is the present one.
        environment: variables to add or replace.

    Raises:
        ValueError: the program failed; the message ends with its last line.
    """
    done = subprocess.run(
        [sys.executable, "-c", program, *map(str, arguments)],
        cwd=folder, env={**os.environ, **environment}, capture_output=True, text=True,
    )  # fmt: skip
    if done.returncode:
        reason = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        raise ValueError(f"{failure}: {reason[-1]}")
    return json.loads(done.stdout.splitlines()[-1])


def add_against(parser: argparse.ArgumentParser) -> None:
    """Add the option --against, which `checkouts` reads."""
    parser.add_argument("--against", type=Path, help="another checkout of this repository")


def checkouts(options: argparse.Namespace) -> list[Path]:
    """Return the checkouts to measure: this one and, if there is one, that of --against.

    Raises:
        ValueError: that folder is no checkout.
    """
    roots = [Path(__file__).resolve().parents[1]]
    if options.against is not None:
        roots.append(options.against.resolve())
    for root in roots:
        if not (root / "planner" / "aero_planner").is_dir():
            raise ValueError(f"{root} is no checkout of this repository: it has no folder planner/aero_planner.")
    return roots


def checkout_path(root: Path) -> str:
    """Return the PYTHONPATH with which Python imports the code of a checkout."""
    return f"{root}{os.pathsep}{root / 'planner'}"


def run_in_checkout(root: Path, program: str, *arguments: object) -> Any:
    """Run a Python program with the code of a checkout, see `run_program`.

    Raises:
        ValueError: the program failed; the message ends with its last line.
    """
    environment = {"PYTHONPATH": checkout_path(root)}
    failure = f"the flight with the code of {root} failed"
    return run_program(program, *arguments, failure=failure, folder=root, environment=environment)


def positive(text: str) -> int:
    """Return the integer, at least 1, that a command-line argument states."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value} is less than 1")
    return value
