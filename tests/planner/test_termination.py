"""Signals that arrive at any moment."""

import os
import signal
import subprocess
import sys
from pathlib import Path

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
elif sys.argv[2] == "generator":
    value = generate()
    next(value)
class Named:
    def __set_name__(self, owner, name):
        send()

try:
    del value
    if sys.argv[2] == "set_name":
        type("Owner", (), {"name": Named()})
    elif sys.argv[2] == "exec":
        exec("send()")
    time.sleep(20.0)
    print("lost")
except KeyboardInterrupt:
    print("interrupted")
    if sys.argv[2] == "WeakSet":
        assert not objects.data
"""


@pytest.mark.parametrize("place", ["del", "finalize", "WeakSet", "callback", "generator", "set_name", "exec"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_that_python_would_ignore_or_replace_is_not_lost(number: signal.Signals, place: str):
    command = [sys.executable, "-c", PROGRAM, str(int(number)), place]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60.0)
    assert (done.returncode, done.stdout, done.stderr) == (0, "interrupted\n", "")


IN_A_TERMINAL = """
import fcntl, sys, termios, time
from aero_planner.termination import install_handler

fcntl.ioctl(0, termios.TIOCSCTTY, 0)
install_handler()
try:
    print("ready", flush=True)
    time.sleep(20.0)
except KeyboardInterrupt:
    print("interrupted", flush=True)
    open(sys.argv[1], "w").close()
"""


def test_results_are_kept_when_the_terminal_is_lost(tmp_path: Path):
    controller, terminal = os.openpty()
    command = [sys.executable, "-c", IN_A_TERMINAL, str(tmp_path / "result")]
    with subprocess.Popen(command, stdin=terminal, stdout=terminal, stderr=terminal, start_new_session=True) as process:
        os.close(terminal)
        assert os.read(controller, 100).startswith(b"ready")
        os.close(controller)
        assert process.wait(60.0) == 0
    assert (tmp_path / "result").exists()


def test_under_nohup_a_lost_terminal_is_ignored():
    code = "import os, signal; from aero_planner.termination import install_handler; install_handler(); "
    code += "os.kill(os.getpid(), signal.SIGHUP); print('goes on')"
    done = subprocess.run(["nohup", sys.executable, "-c", code], capture_output=True, text=True, timeout=60.0)
    assert (done.returncode, done.stdout) == (0, "goes on\n")


def test_other_errors_of_finalizers_are_still_reported():
    code = PROGRAM.split("class Named")[0].replace("send()", "raise ValueError('broken')") + "del value\n"
    done = subprocess.run([sys.executable, "-c", code, "2", "del"], capture_output=True, text=True, timeout=60.0)
    assert done.returncode == 0 and done.stderr.endswith("ValueError: broken\n"), done.stderr


MOMENTS = """
import itertools, os, sys, tempfile, time
from aero_planner.termination import install_handler

install_handler()
number, place = int(sys.argv[1]), sys.argv[2]

def work():
    with tempfile.TemporaryDirectory(dir=place) as folder:
        open(os.path.join(folder, "file"), "w").close()

def interrupted_at(moment):
    # Send the signal when `moment` instructions of work or lines of other functions have begun.
    left = moment

    def trace(frame, event, argument):
        nonlocal left
        if frame.f_code is work.__code__:
            frame.f_trace_opcodes, frame.f_trace_lines = True, False
        if event in ("line", "opcode"):
            left -= 1
            if not left:
                sys.settrace(None)
                os.kill(os.getpid(), number)
                for _ in range(1000):  # the handler is called in here
                    pass
        return trace

    try:
        sys.settrace(trace)
        try:
            work()
        finally:
            sys.settrace(None)
        if left > 0:
            return False
        time.sleep(20.0)
        sys.exit(f"lost at {moment}")
    except KeyboardInterrupt:
        pass
    return True

for moment in itertools.count(1):
    is_sent = interrupted_at(moment)
    if os.listdir(place):
        sys.exit(f"left behind at {moment}")
    if not is_sent:
        break
print("complete", moment > 50)
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_at_any_moment_leaves_no_temporary_folder(number: signal.Signals, tmp_path: Path):
    command = [sys.executable, "-c", MOMENTS, str(int(number)), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60.0)
    assert (done.returncode, done.stdout, done.stderr) == (0, "complete True\n", "")
