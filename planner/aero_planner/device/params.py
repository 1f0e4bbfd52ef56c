"""The live parameters as a Warp struct in device memory, one per drone."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from aero_planner.config import ParameterInfo, PlannerConfig

_LIVE: tuple[ParameterInfo, ...] = tuple(info for info in PlannerConfig.parameters() if info.live)


for _info in _LIVE:
    if (_same := next(info for info in _LIVE if info.name == _info.name)) is not _info:
        raise ValueError(
            f"{_same.path} and {_info.path} have the same name; kernels read live parameters by it: rename one of them."
        )


def _warp_type(info: ParameterInfo) -> Any:
    if info.pack is not None:
        return wp.types.matrix(info.pack(str(info.default)).shape, wp.float32)
    return wp.int32 if info.choices or isinstance(info.default, bool | int) else wp.float32


# One field per live parameter, by its name: `params.q_track` is costs.q_track. A switch is 0 or 1, a choice is its
# index.
Params: Any = wp.struct(
    type("Params", (), {"__annotations__": {info.name: _warp_type(info) for info in _LIVE}, "__module__": __name__})
)


def pack(config: PlannerConfig) -> Any:
    """Return the live parameters of `config` as one record, shape [], of `Params.numpy_dtype()`."""
    record: Any = np.zeros((), dtype=Params.numpy_dtype())
    for info in _LIVE:
        value = config.get(info.path)
        if info.pack is not None:
            value = info.pack(str(value))
        record[info.name] = info.choices.index(str(value)) if info.choices else value
    return record
