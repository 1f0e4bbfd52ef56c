import os
import subprocess
import sys
import threading
import time

import pytest
import warp as wp

from aero_planner.launch_sequence import PLAN, LaunchSequence, usable_cores

ON_ONE_CORE = """
import os, threading
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
from aero_planner import Goal, Planner, VehicleState
state = VehicleState([0, 0, 2], [4, 0, 0], [1, 0, 0, 0])
Planner(device="cpu").plan(state, Goal([30, 0, 2]), [[5.0, 0, 2]])
print(threading.active_count())
"""


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system has no CPU affinity")
def test_a_planner_on_dedicated_cores_has_no_threads_for_others():
    done = subprocess.run([sys.executable, "-c", ON_ONE_CORE], capture_output=True, text=True, check=True)
    assert done.stdout == "1\n"


def test_at_least_one_core_is_usable():
    assert 1 <= usable_cores() <= (os.cpu_count() or 1)


def test_after_ctrl_c_no_launch_runs_on():
    """The arrays may be freed next."""
    begun = threading.Event()
    ended: list[bool] = []

    def launch() -> None:
        if threading.current_thread() is threading.main_thread():
            begun.wait()
            raise KeyboardInterrupt
        begun.set()
        time.sleep(0.2)
        ended.append(True)

    sequence = LaunchSequence(wp.get_device("cpu"), 2)
    sequence.stages[PLAN] = [[[("stage", launch)], [("stage", launch)]]]
    with pytest.raises(KeyboardInterrupt):
        sequence.run()
    assert ended
    sequence.close()
