"""Commands and other messages to the autopilot over MAVLink 2, signed if there is a key."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from aero_planner.onboard.frames import attitude_to_ned, frd_from_flu
from aero_planner.onboard.mavlink_signing import signing_time
from aero_planner.onboard.thrust import ThrustModel
from aero_planner.onboard.transport import Address, Transport


def load_dialect() -> Any:
    """Return pymavlink's module of the common messages.

    Raises:
        ImportError: pymavlink is not installed; names the extra to install.
    """
    try:
        from pymavlink.dialects.v20 import common
    except ImportError as error:
        raise ImportError("MAVLink needs pymavlink, which is not installed; run: pip install pymavlink.") from error
    return common


class MavlinkSender:
    """Packs commands and other messages and sends them; implements `aero_planner.onboard.interfaces.CommandSink`.

    Args:
        transport: Connection to the autopilot; None sends nothing. It may be replaced at any time.
        system: System id of the autopilot and of this computer.
        component: Component id of this computer.
        thrust: Thrust model of the vehicle.
        clock: Host time [s].
        key: Key with which every message is signed, 32 bytes; None signs none.
        link_id: Number of the connection in the signatures; each sender has its own.

    Raises:
        ImportError: pymavlink is not installed.

    Attributes:
        transport: Connection to the autopilot.
        sent: Number of commands sent.
        thrust_gain: True thrust divided by what the thrust model says, see `aero_planner.onboard.thrust_estimate`.
        min_signing_time: Earliest time stamp of the next signature, see `aero_planner.onboard.mavlink_signing`. The
            autopilot accepts none that is much older than its own clock.
    """

    def __init__(
        self,
        transport: Transport | None,
        *,
        system: int,
        component: int,
        thrust: ThrustModel,
        clock: Callable[[], float] = time.monotonic,
        key: bytes | None = None,
        link_id: int = 0,
    ) -> None:
        self.transport = transport
        self.sent = 0
        self.min_signing_time = 0
        self.thrust_gain = 1.0
        self._dialect = load_dialect()
        self._system = system
        self._component = component
        self._thrust = thrust
        self._time = clock
        self._packer = self._dialect.MAVLink(None, srcSystem=system, srcComponent=component)
        self._sending = threading.Lock()
        self._signing = self._packer.signing
        self._signing.secret_key, self._signing.link_id = key, link_id
        self._signing.sign_outgoing = key is not None

    def send(self, command: ArrayLike, attitude: ArrayLike | None = None) -> None:
        """Command a thrust F_t [N] and body rates omega [rad/s], shape [4], forward-left-up. Never blocks.

        Args:
            command: Thrust and rates.
            attitude: Attitude to which the rates turn, body to world, w x y z, shape [4]. PX4 turns to it by
                itself, but only after 0.4 s, in which it follows the rates. None sends rates alone.

        Raises:
            ValueError: The command has another shape or is not finite; nothing was sent.
        """
        values = np.asarray(command, dtype=np.float64)
        if values.shape != (4,) or not np.isfinite(values).all():
            raise ValueError(f"the command is {values.tolist()}; it must be a thrust and three rates, all finite.")
        thrust = self._thrust.signal(float(values[0]) / self.thrust_gain)
        rates = frd_from_flu(values[1:])
        message = self._dialect.MAVLink_set_attitude_target_message(
            int(1e3 * self._time()) & 0xFFFFFFFF,
            self._system,
            self._dialect.MAV_COMP_ID_AUTOPILOT1,
            self._dialect.ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE if attitude is None else 0,
            [1.0, 0.0, 0.0, 0.0] if attitude is None else attitude_to_ned(attitude).tolist(),
            *rates.tolist(),
            thrust,
        )
        self.sent += self.send_message(message)

    def send_message(self, message: Any, address: Address | None = None) -> bool:
        """Send one of the dialect's messages, to the autopilot or to an address; return False if there is no room."""
        with self._sending:
            self._signing.timestamp = max(self._signing.timestamp, self.min_signing_time, signing_time())
            data = message.pack(self._packer)
            self._packer.seq = (self._packer.seq + 1) % 256
            return self.transport is not None and self.transport.send(bytes(data), address)
