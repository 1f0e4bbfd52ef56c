"""Log lines with the reasons for which the node is not READY."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence

from aero_planner.onboard.failsafe_table import Cause

_log = logging.getLogger(__name__)

_SETTLING_TIME = 1.0
"""Time for which the reasons must have stayed the same before they are logged [s]: at the start they change often."""


class ReadinessLog:
    """Logs why the node is not READY, once for each change of the reasons."""

    def __init__(self) -> None:
        self._reasons: tuple[str, ...] = ()
        self._since = math.inf
        self._logged: tuple[str, ...] = ()

    def update(self, now: float, missing: Sequence[Cause], *, has_goal: bool) -> None:
        """Log what is missing at the time `now` [s] if it is new and has settled; that may be nothing."""
        reasons = (*(() if has_goal else ("there is no goal",)), *(cause.value for cause in missing))
        if reasons != self._reasons:
            self._reasons, self._since = reasons, now
        if self._reasons != self._logged and now - self._since >= _SETTLING_TIME:
            self._logged = self._reasons
            if self._reasons:
                _log.info("not READY: %s", "; ".join(self._reasons))
