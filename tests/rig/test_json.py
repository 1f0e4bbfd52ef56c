"""With --json stdout holds JSON alone: the rig as its own user, such as `jq`, runs it."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest


def test_stdout_holds_one_object_per_flight_and_nothing_else():
    command = [sys.executable, "-m", "aero_planner", "rig", "forest", "--json", "--duration", "0.2", "--count", "2"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    flights = [json.loads(line, parse_constant=pytest.fail) for line in done.stdout.splitlines()]
    assert [flight["seed"] for flight in flights] == [0, 1] and done.stderr == ""
    for events in (flight["events"] for flight in flights):
        assert events[0] == {"time": None, "text": "node started"}
        assert [event["time"] is None for event in events].index(False) >= 2  # arming comes before the take-over, too
