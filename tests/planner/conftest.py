from __future__ import annotations

import pytest
import warp as wp


def _devices() -> list[str]:
    wp.config.log_level = wp.LOG_WARNING
    present = [str(device) for device in wp.get_devices()]
    return [name for name in ("cpu", "cuda:0") if name in present]


@pytest.fixture(scope="session", params=_devices())
def device(request: pytest.FixtureRequest) -> str:
    """Every device that the planner can run on here."""
    return request.param
