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

def send(*unused):
    os.kill(os.getpid(), number)
    for _ in range(1000):  # the handler is called in here
        pass

class Slow:
    def __del__(self):
        send()

class Watched:
    pass

class SlowSet(set):
    def discard(self, item):
        send()
        super().discard(item)

def generate():
    try:
        yield
    finally:
        send()

value = Watched()
if sys.argv[2] == "del":
    value = Slow()
elif sys.argv[2] == "finalize":
    weakref.finalize(value, send)
elif sys.argv[2] == "WeakSet":
    objects = weakref.WeakSet()
    objects.data = SlowSet()
    objects.add(value)
elif sys.argv[2] == "callback":
    reference = weakref.ref(value, send)
else:
    value = generate()
    next(value)
try:
    del value
    time.sleep(20.0)
    print("lost")
except KeyboardInterrupt:
    print("interrupted")
    if sys.argv[2] == "WeakSet":
        assert not objects.data
"""


@pytest.mark.parametrize("finalizer", ["del", "finalize", "WeakSet", "callback", "generator"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_an_object_is_finalized_is_not_lost(number: signal.Signals, finalizer: str):
    command = [sys.executable, "-c", PROGRAM, str(int(number)), finalizer]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60.0)
    assert (done.returncode, done.stdout, done.stderr) == (0, "interrupted\n", "")


def test_other_errors_of_finalizers_are_still_reported():
    code = PROGRAM.split("try:\n    del")[0].replace("send()", "raise ValueError('broken')") + "del value\n"
    done = subprocess.run([sys.executable, "-c", code, "2", "del"], capture_output=True, text=True, timeout=60.0)
    assert done.returncode == 0 and done.stderr.endswith("ValueError: broken\n"), done.stderr
