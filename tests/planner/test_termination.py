"""Signals that arrive at any moment."""

import signal
import subprocess
import sys

import pytest

PROGRAM = """
import os, sys, time, weakref
from aero_planner.termination import install_handler

install_handler()
number = int(sys.argv[1])

def send():
    os.kill(os.getpid(), number)
    for _ in range(1000):  # the handler is called in here
        pass

class Slow:
    def __del__(self):
        send()

class Watched:
    pass

if sys.argv[2] == "del":
    value = Slow()
else:
    value = Watched()
    weakref.finalize(value, send)
try:
    del value
    time.sleep(20.0)
    print("lost")
except KeyboardInterrupt:
    print("interrupted")
"""


@pytest.mark.parametrize("finalizer", ["del", "weakref"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_an_object_is_finalized_is_not_lost(number: signal.Signals, finalizer: str):
    command = [sys.executable, "-c", PROGRAM, str(int(number)), finalizer]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60.0)
    assert (done.returncode, done.stdout, done.stderr) == (0, "interrupted\n", "")
