"""With --json, stdout contains JSON only, for programs such as `jq`."""

import json
import subprocess
import sys

import pytest


def test_stdout_contains_one_json_object_per_flight():
    command = [sys.executable, "-m", "aero_planner", "rig", "forest", "--json", "--duration", "0.2", "--count", "2"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    flights = [json.loads(line, parse_constant=pytest.fail) for line in done.stdout.splitlines()]
    assert [flight["seed"] for flight in flights] == [0, 1] and done.stderr == ""
    for events in (flight["events"] for flight in flights):
        assert events[0] == {"time": None, "text": "node started"}
        assert [event["time"] is None for event in events].index(False) >= 2  # arming comes before the engagement, too
