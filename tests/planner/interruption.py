"""Ctrl-C while a program is still being imported."""

import subprocess
import sys

_CODE = """
import os, signal, sys

class Interruption:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interruption())
sys.argv = {arguments!r}
{start}
"""


def interrupted_at_import(module: str, start: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run `start` with sys.argv `arguments` in a process that gets a SIGINT when it begins to import `module`."""
    code = _CODE.format(module=module, arguments=list(arguments), start=start)
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
