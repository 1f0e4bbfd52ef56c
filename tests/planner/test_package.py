"""Public names of the package, and the cost of importing it."""

import subprocess
import sys

import pytest

import aero_planner


def test_every_public_name_can_be_imported():
    assert set(aero_planner.__all__) <= set(dir(aero_planner))
    assert all(callable(getattr(aero_planner, name)) for name in aero_planner.__all__)
    with pytest.raises(AttributeError, match="module 'aero_planner' has no attribute 'Plnner'"):
        aero_planner.Plnner  # type: ignore[attr-defined] # noqa: B018


def test_functions_are_not_shadowed_by_modules_of_the_same_name():
    code = (
        "import aero_planner.deploy.export; from aero_planner import *; assert callable(warmup) and callable(Planner)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_importing_the_package_imports_neither_numpy_nor_warp():
    code = "import sys, aero_planner, aero_planner.cli; print({'numpy', 'warp'} & sys.modules.keys() or 'light')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "light\n"
