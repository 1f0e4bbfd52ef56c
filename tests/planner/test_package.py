"""What `import aero_planner` gives."""

from __future__ import annotations

import subprocess
import sys

import pytest

import aero_planner


def test_every_public_name_is_there():
    assert set(aero_planner.__all__) <= set(dir(aero_planner))
    assert all(callable(getattr(aero_planner, name)) for name in aero_planner.__all__)
    with pytest.raises(AttributeError, match="module 'aero_planner' has no attribute 'Plnner'"):
        aero_planner.Plnner  # type: ignore[attr-defined] # noqa: B018


def test_a_name_stays_a_function_whatever_was_imported_before():
    code = (
        "import aero_planner.deploy.export; from aero_planner import *; assert callable(warmup) and callable(Planner)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_package_alone_is_light():
    code = "import sys, aero_planner, aero_planner.cli; print({'numpy', 'warp'} & sys.modules.keys() or 'light')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "light\n"
