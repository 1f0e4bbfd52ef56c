from __future__ import annotations

import pytest
import warp as wp


def _devices() -> list[str]:
    wp.config.log_level = wp.LOG_WARNING
    return ["cpu", "cuda:0"] if wp.is_cuda_available() else ["cpu"]


@pytest.fixture(scope="session", params=_devices())
def device(request: pytest.FixtureRequest) -> str:
    """Every device that the planner can run on here."""
    return request.param
