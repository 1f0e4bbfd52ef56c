"""A few thousand inputs of the fuzzer for the node's ports; `make fuzz` runs more."""

import resource
from pathlib import Path

import numpy as np
import pytest
from fuzz.ports import PORTS

GROWTH = 64
"""Largest growth of this process's memory after the first half of the cases [MB]."""


@pytest.mark.parametrize("name", PORTS)
def test_no_input_from_the_network_breaks_a_parser(name: str, tmp_path: Path):
    port, path = PORTS[name], tmp_path / name
    count, accepted, start = 27 if port.inputs > 1 else 1000, 0, 0.0
    for number in range(count):
        path.write_bytes(port.generate(np.random.default_rng([1, number])))
        try:
            accepted += port.feed(path)
        except ValueError as error:
            assert str(error).endswith(".") and "\n" not in str(error), str(error)
        if number == count // 2:
            start = _peak()
    assert accepted > 0, "the fuzzer produces only inputs that are refused at once"
    assert _peak() - start <= GROWTH


def _peak() -> float:
    """Return the peak memory of this process [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
