import os
import subprocess
import sys

import pytest

from aero_planner.launch_sequence import usable_cores

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
