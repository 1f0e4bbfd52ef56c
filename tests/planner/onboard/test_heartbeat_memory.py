"""The memory that the node and its failsafe process share."""

import math
import mmap
import os
from collections.abc import Iterator

import numpy as np
import pytest

from aero_planner.onboard.dead_reckoning import MotionState
from aero_planner.onboard.heartbeat_memory import HeartbeatMemory
from aero_planner.onboard.watchdog import UPCOMING_MAX, Heartbeat
from tests.planner.onboard.simulated import flying_north

COMMAND = np.array([9.81, 0.0, 0.0, 0.0])


@pytest.fixture
def file() -> Iterator[int]:
    file = HeartbeatMemory.create_file()
    yield file
    os.close(file)


@pytest.fixture
def memory(file: int) -> HeartbeatMemory:
    return HeartbeatMemory(file)


def test_the_reader_gets_what_was_written(memory: HeartbeatMemory, file: int):
    reader = HeartbeatMemory(file)
    assert reader.read() is None
    motion = MotionState(4.9, np.array([1.0, 2.0, 3.0]), np.array([4.0, 5.0, 6.0]), np.array([0.5, 0.5, -0.5, 0.5]))
    for count in range(1, 5):
        written = Heartbeat(5.0 + count, motion, np.array([9.0, 0.1, 0.2, count]))
        memory.write(written, "udpout:10.0.0.1:14540", 2**47 + count)
        number, heartbeat, peer, signing_time = reader.read() or pytest.fail("there is none")
        assert (number, heartbeat.time, peer) == (count, 5.0 + count, "udpout:10.0.0.1:14540")
        assert signing_time == 2**47 + count
        assert heartbeat.motion is not None and heartbeat.motion.time == 4.9
        for name in ("position", "velocity", "quaternion"):
            np.testing.assert_array_equal(getattr(heartbeat.motion, name), getattr(motion, name))
        np.testing.assert_array_equal(heartbeat.command, [9.0, 0.1, 0.2, count])
    planned = np.arange(4.0 * (UPCOMING_MAX + 3)).reshape(-1, 4)
    for upcoming in (planned[:1], planned[:5], planned[:UPCOMING_MAX], planned):
        memory.write(Heartbeat(9.0, motion, COMMAND, upcoming, thrust_gain=0.9), None)
        _, heartbeat, *_ = reader.read() or pytest.fail("there is none")
        assert heartbeat.thrust_gain == 0.9
        np.testing.assert_array_equal(heartbeat.upcoming, upcoming[:UPCOMING_MAX])
    memory.write(Heartbeat(10.0, None, None), None)
    assert reader.read() == (9, Heartbeat(10.0, None, None), None, 0)
    assert memory.read_status() == (0, False, 0)
    reader.write_status(8, 3)
    assert memory.read_status() == (1, False, 3)
    reader.write_status(9, 3)
    assert memory.read_status() == (2, True, 3)
    memory.write(Heartbeat(11.0, None, None), None)
    assert memory.read_status() == (2, False, 3)  # it braked after an older heartbeat


def test_a_motion_that_is_not_finite_reads_as_none(memory: HeartbeatMemory):
    memory.write(Heartbeat(5.0, flying_north(math.nan), np.array([9.0, math.inf, 0.0, 0.0])), None)
    assert memory.read() == (1, Heartbeat(5.0, None, None), None, 0)


def test_a_memory_of_another_version_is_refused(file: int):
    end = os.lseek(file, 0, os.SEEK_END)
    os.pwrite(file, b"\xff", end - 4)
    with pytest.raises(ValueError, match="another version"):
        HeartbeatMemory(file)


@pytest.mark.parametrize("written", [1, 2, 3, 4])
def test_a_writer_stopped_anywhere_leaves_the_previous_heartbeat(memory: HeartbeatMemory, file: int, written: int):
    for count in range(1, written + 1):
        memory.write(Heartbeat(float(count), flying_north(count), COMMAND + count), f"udpout:127.0.0.1:{count}")
    content = mmap.mmap(file, 0)
    before = content[:]
    memory.write(Heartbeat(-7.0, flying_north(-7.0), -COMMAND), "/dev/ttyTHS1")
    after = content[:]
    (changed,) = np.nonzero(np.frombuffer(before, np.uint8) != np.frombuffer(after, np.uint8))
    first, last = int(changed[0]), int(changed[-1])
    for end in range(first, last + 1):
        content[:] = after[:end] + before[end:]
        found = memory.read()
        assert found is not None and found[0] == written and found[1].time == written, end
    # The same if the bytes are written in another order, such as the end first.
    for begin in range(first + 1, last + 1):
        content[:] = before[:begin] + after[begin:]
        found = memory.read()
        assert found is not None and found[0] == written, begin
    content[:] = after
    found = memory.read()
    assert found is not None and found[0] == written + 1 and found[2] == "/dev/ttyTHS1"
