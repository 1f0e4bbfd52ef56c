"""Fixtures for the tests of scenes."""

import contextlib
from collections.abc import Iterator

import pytest

from aero_viz.scenes import map_files
from aero_viz.scenes.decoding_process import DecodingProcess


@pytest.fixture(scope="module", autouse=True)
def shared_decoding_process() -> Iterator[None]:
    """One process that decodes all files of a module: it takes longer to start than to read a small file."""
    with pytest.MonkeyPatch.context() as patch, DecodingProcess() as process:
        patch.setattr(map_files, "DecodingProcess", lambda: contextlib.nullcontext(process))
        yield
