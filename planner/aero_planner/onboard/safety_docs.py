"""Diagram and tables of docs/onboard_safety.md, generated from the failsafe table that the node runs.

    python -m aero_planner.onboard.safety_docs

prints them.
"""

from __future__ import annotations

from aero_planner.onboard.failsafe_table import (
    COMMANDING,
    DETECTION,
    FAULTS,
    REACTION_OVERRIDES,
    REACTIONS,
    THRESHOLDS,
    TRANSITIONS,
    Cause,
    Reaction,
    State,
    reaction_to,
)
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.plain_text import say


def format_diagram() -> str:
    """Return the machine as a Mermaid state diagram, in which "any fault" stands for all of `FAULTS`."""
    edges: dict[tuple[State, State], list[Cause]] = {}
    for row in TRANSITIONS:
        for source in row.sources:
            edges.setdefault((source, row.target), []).append(row.cause)
    lines = ["stateDiagram-v2", f"    [*] --> {State.WAITING.name}"]
    for (source, target), causes in edges.items():
        names = [_words(cause) for cause in causes if cause not in FAULTS]
        faults = [cause for cause in causes if cause in FAULTS]
        names += ["any fault"] if len(faults) == len(FAULTS) else [_words(cause) for cause in faults]
        lines.append(f"    {source.name} --> {target.name}: {', '.join(names)}")
    return "\n".join(lines)


def format_states() -> str:
    """Return Markdown tables of the states, with the reaction in each, and of the reactions."""
    lines = ["| state | meaning | reaction |", "| --- | --- | --- |"]
    lines += [f"| {state.name} | {state.value} | {_reactions(state)} |" for state in State]
    lines += ["", "| reaction | what is sent to the autopilot |", "| --- | --- |"]
    lines += [f"| {reaction.name} | {reaction.value} |" for reaction in Reaction]
    return "\n".join(lines)


def format_failsafes(config: OnboardConfig | None = None) -> str:
    """Return a Markdown table with the reaction to each event that ends or disturbs a flight, and its time limit."""
    config = config or OnboardConfig()
    lines = ["| event | in | then | reaction | within | setting |", "| --- | --- | --- | --- | --- | --- |"]
    for cause, paths in DETECTION.items():
        within = sum(float(config.get(path)) for path in paths) + 1.0 / config.rates.control
        thresholds = ", ".join(f"`{path}`" for path in THRESHOLDS.get(cause, ()))
        names = " + ".join(f"`{path}`" for path in paths) or thresholds
        for target in State:
            rows = [row for row in TRANSITIONS if row.cause is cause and row.target is target]
            sources = [state.name for row in rows for state in row.sources if state in COMMANDING]
            if sources:
                cells = (cause.value, ", ".join(sources), target.name, reaction_to(target, (cause,)).name)
                lines.append(f"| {' | '.join(cells)} | {within:.2f} s | {names} |")
    return "\n".join(lines)


def _reactions(state: State) -> str:
    """Return the names of the reactions in `state`, with the faults that select each exception."""
    exceptions: dict[Reaction, list[str]] = {}
    for (exception_state, causes), reaction in REACTION_OVERRIDES.items():
        if exception_state is state:
            exceptions.setdefault(reaction, []).append(" and ".join(_words(cause) for cause in causes))
    texts = [f"{reaction.name} if the only faults are {', or '.join(names)}" for reaction, names in exceptions.items()]
    return "; ".join((REACTIONS[state].name, *texts))


def _words(cause: Cause) -> str:
    return cause.name.lower().replace("_", " ")


if __name__ == "__main__":
    say(format_diagram(), format_states(), format_failsafes(), sep="\n\n")
