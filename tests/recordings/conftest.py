"""Fixtures that write recordings."""

from collections.abc import Callable
from pathlib import Path

import bags
import pytest


@pytest.fixture
def mcap_of(tmp_path: Path) -> Callable[[list[bags.Item]], Path]:
    """Return a function that writes messages into an MCAP file."""
    return lambda items: bags.write_mcap(tmp_path / "a.mcap", sorted(items, key=lambda item: item.time))


@pytest.fixture(params=sorted(bags.FORMATS))
def written(request: pytest.FixtureRequest, tmp_path: Path) -> Callable[[list[bags.Item]], Path]:
    """Return a function that writes messages in one of the formats."""
    return lambda items: bags.FORMATS[request.param](tmp_path, items)
