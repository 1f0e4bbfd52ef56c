"""The report of `inspect`."""

import json

import bags
import pytest
from command_line import run_refused

from aero_viz.recordings import inspect


def test_json_has_the_documented_keys(mcap_of):
    report = json.loads(json.dumps(inspect(mcap_of(bags.drive())).to_dict()))
    assert {"format", "duration_s", "topics", "sweeps", "poses", "points_per_sweep", "problems"} <= set(report)
    assert report["topics"][0] == {"name": "/odom", "type": "nav_msgs/msg/Odometry", "count": 37}
    assert report["points_per_sweep"] == {"min": 200, "median": 200, "max": 200}


def test_table_marks_the_topics_that_are_played(mcap_of):
    table = inspect(mcap_of(bags.drive(child="base_link"))).format_table()
    assert "/points" in table and "<- sweeps" in table and "<- poses" in table
    assert "10 sweeps can be played, 37 poses" in table
    assert "note: poses on /odom" in table


def test_empty_recording_has_no_sweeps(mcap_of):
    info = inspect(mcap_of([]))
    assert info.sweeps == 0 and info.topics == () and info.points_per_sweep is None
    assert "it holds no topics" in info.problems[0]
    assert f"FAULT (unplayable): {info.problems[0]}" in info.format_table()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--poses", "absent.txt"), "Cannot read the poses absent.txt"),
        (("--extrinsic", "0", "0", "0", "0", "0", "nan"), "--extrinsic takes six finite numbers"),
        (("--mask", "1", "1", "1", "-1", "-1", "-1"), "--mask takes the lower corner of a box before the upper one"),
    ],
)
def test_a_wrong_option_is_refused(
    mcap_of, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], message: str
):
    assert message in run_refused(capsys, "inspect", str(mcap_of(bags.drive())), *arguments)
