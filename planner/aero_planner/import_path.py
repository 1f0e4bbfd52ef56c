"""Keeps the current folder off the path of imports, here and in child processes.

`python -m` and `python -c` put it first, and an empty entry of PYTHONPATH adds it. A file `numpy.py` beside a
downloaded map would run then. Only modules that the interpreter has loaded already are imported here.
"""

import os
import sys

_PACKAGES = ("aero_planner", "aero_viz")
_RUN_MODULE = """
import sys
sys.path = [folder for folder in sys.path if folder]
del sys.argv[0]
import runpy
runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
"""


def leave_current_folder() -> None:
    """Take the current folder off the path of this process and of every Python process that it starts.

    It stays if this package lies there, if PYTHONPATH names it by an absolute path, or if a package is installed from
    there.
    """
    sys.path[:] = import_path()
    os.environ["PYTHONSAFEPATH"] = "1"  # Python 3.11 and newer obey it
    if "PYTHONPATH" in os.environ:
        folders = map(os.path.abspath, filter(None, os.environ["PYTHONPATH"].split(os.pathsep)))
        os.environ["PYTHONPATH"] = os.pathsep.join(folder for folder in folders if folder in sys.path)


def import_path() -> list[str]:
    """Return the folders of sys.path from which modules may be imported; relative ones are none of them.

    Behind the standard library are folders of installed packages: there, the current one is that of an editable one.
    """
    folders = [folder for folder in sys.path if os.path.isabs(folder)]
    try:
        current = os.path.realpath(os.getcwd())
    except FileNotFoundError:  # it was removed
        return folders
    named = filter(os.path.isabs, os.environ.get("PYTHONPATH", "").split(os.pathsep))
    files = [getattr(sys.modules.get(package), "__file__", None) for package in _PACKAGES]
    packages = (os.path.dirname(os.path.dirname(file)) for file in files if file)
    if current in map(os.path.realpath, (*named, *packages)):
        return folders
    library = os.path.dirname(os.__file__)
    installed = folders.index(library) if library in folders else len(folders)
    return [folder for i, folder in enumerate(folders) if i > installed or os.path.realpath(folder) != current]


def module_command(module: str, *arguments: str) -> list[str]:
    """Return the command that runs a module as `python -m` does, without the current folder on its path.

    The process needs `child_environment` to find the modules of this one. Unlike -P, this works with Python 3.10, too.
    """
    return [sys.executable, "-c", _RUN_MODULE, module, *arguments]


def child_environment(**variables: str) -> dict[str, str]:
    """Return the environment of a Python process that finds the same modules as this one, with further variables."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(import_path()), "PYTHONSAFEPATH": "1", **variables}
