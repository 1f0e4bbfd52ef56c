"""Ctrl-C while a program is still being imported."""

import subprocess
import sys

_CODE = """
import os, signal, sys, time

def interrupt():
    os.kill(os.getpid(), signal.SIGINT)
    for _ in range(1000):  # the handler is called in here
        pass

class Finalized:
    def __del__(self):
        interrupt()

class Interruption:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            if {finalizing}:
                Finalized()
                time.sleep(20.0)
            else:
                interrupt()

sys.meta_path.insert(0, Interruption())
sys.argv = {arguments!r}
{start}
"""


def interrupted_at_import(
    module: str, start: str, *arguments: str, finalizing: bool = False
) -> subprocess.CompletedProcess[str]:
    """Run `start` with sys.argv `arguments` in a process that gets a SIGINT when it begins to import `module`.

    Args:
        module: name of the module.
        start: code.
        arguments: arguments of the program, the first of which is its name.
        finalizing: send the signal while an object is finalized.
    """
    code = _CODE.format(module=module, arguments=list(arguments), start=start, finalizing=finalizing)
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
