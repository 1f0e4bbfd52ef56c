"""Reading in a process of its own: results, limits, cancellation and crashes."""

import os
import runpy
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from aero_viz.catalog import load_world
from aero_viz.errors import UserError
from aero_viz.reader_process import Limits, ReadCancelled, ReaderProcess


def test_the_result_is_that_of_the_function(tmp_path):
    world = load_world("pillars", seed=3)
    world.save(tmp_path / "world.json")
    read = ReaderProcess()(load_world, str(tmp_path / "world.json"), seed=1)
    np.testing.assert_array_equal(read.boxes, world.boxes)


def test_it_is_another_process_and_what_it_prints_is_no_result(capfd):
    assert ReaderProcess()(os.getpid) != os.getpid()
    assert ReaderProcess()(print, "noise", flush=True) is None
    assert capfd.readouterr() == ("", "")


def test_an_error_is_passed_on(tmp_path):
    with pytest.raises(UserError, match=r"absent\.json"):
        ReaderProcess()(load_world, str(tmp_path / "absent.json"))
    with pytest.raises(UserError, match="ZeroDivisionError"):
        ReaderProcess()(divmod, 1, 0)


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not limit the memory of a process")
def test_memory_is_limited():
    with pytest.raises(UserError, match=r"more than 0\.3 GB"):
        ReaderProcess(Limits(memory=300_000_000))(bytearray, 400_000_000)


def test_time_is_limited():
    with pytest.raises(UserError, match=r"longer than 0\.5 s"):
        ReaderProcess(Limits(seconds=0.5))(time.sleep, 60.0)


@pytest.mark.parametrize("end", [(os.abort,), (os._exit, 3)], ids=["abort", "exit"])
def test_a_crash_is_an_error(end):
    with pytest.raises(UserError, match="ended with code"):
        ReaderProcess()(*end)


def test_reading_can_be_cancelled():
    reader = ReaderProcess()
    timer = threading.Timer(0.3, reader.cancel)
    timer.start()
    with pytest.raises(ReadCancelled):
        reader(time.sleep, 600.0)


def test_a_kept_process_serves_many_calls_and_is_replaced_after_a_crash():
    reader = ReaderProcess(is_kept=True)
    first = reader(os.getpid)
    assert reader(os.getpid) == first
    with pytest.raises(UserError, match="ZeroDivisionError"):
        reader(divmod, 1, 0)
    assert reader(os.getpid) == first
    with pytest.raises(UserError, match="ended with code"):
        reader(os.abort)
    assert reader(os.getpid) != first
    reader.close()


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not limit the memory of a process")
def test_every_call_of_a_kept_process_has_its_own_limits():
    reader = ReaderProcess(is_kept=True)
    with pytest.raises(UserError, match=r"more than 0\.3 GB"):
        reader.call(Limits(memory=300_000_000), bytearray, 400_000_000)
    assert len(reader.call(Limits(memory=2_000_000_000), bytes, 400_000_000)) == 400_000_000
    with pytest.raises(UserError, match=r"more than 1 s of CPU time"):
        reader.call(Limits(cpu_seconds=1.0), pow, 3, 10**9)
    with pytest.raises(UserError, match=r"longer than 0\.5 s"):
        reader.call(Limits(seconds=0.5), time.sleep, 60.0)
    assert reader(divmod, 7, 2) == (3, 1)
    reader.close()


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not count what a process reads")
def test_progress_counts_what_was_read(tmp_path):
    (tmp_path / "large").write_bytes(bytes(30_000_000))
    (script := tmp_path / "script.py").write_text(
        f"import time\nopen({str(tmp_path / 'large')!r}, 'rb').read()\ntime.sleep(600)\n"
    )
    seen, reader = [], ReaderProcess()
    timer = threading.Thread(target=lambda: collect_progress(reader, seen))
    timer.start()
    with pytest.raises(ReadCancelled):
        reader(runpy.run_path, str(script))
    timer.join()
    assert seen == ["30 MB"]


def collect_progress(reader: ReaderProcess, seen: list[str]) -> None:
    deadline = time.monotonic() + 60.0
    while not reader.progress.startswith("30 MB") and time.monotonic() < deadline:
        time.sleep(0.01)
    seen.append(reader.progress.split(",")[0])
    reader.cancel()


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such priorities")
def test_a_real_time_priority_is_not_inherited():
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    except PermissionError:
        pytest.skip("this user may not have a real-time priority")
    try:
        policy = ReaderProcess()(os.sched_getscheduler, 0)
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    assert policy == os.SCHED_OTHER


@pytest.mark.skipif(not Path("/proc/self/autogroup").exists(), reason="this system does not weigh sessions")
def test_the_process_weighs_less_than_this_session_and_leaves_its_weight():
    group, before = Path("/proc/self/autogroup"), Path("/proc/self/autogroup").read_text()
    # Linux lets unprivileged users change ten weights per second, all together.
    assert any(ReaderProcess()(Path.read_text, group).endswith("nice 10\n") for _ in range(20))
    kept = ReaderProcess(is_kept=True)
    assert kept(Path.read_text, group) == before == group.read_text()
    kept.close()


def test_a_cancelled_reader_starts_nothing():
    reader = ReaderProcess()
    assert not reader.is_cancelled
    reader.cancel()
    assert reader.is_cancelled
    with pytest.raises(ReadCancelled):
        reader(time.sleep, 60.0)
