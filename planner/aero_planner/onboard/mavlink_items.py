"""Mission items of MAVLink as waypoints: NAV_WAYPOINT, and DO_CHANGE_SPEED for the legs that follow."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

from aero_planner.missions import Mission, Waypoint, as_position
from aero_planner.onboard.frames import world_from_ned

_EARTH_RADIUS = 6_371_000.0
"""Of PX4's map projection [m]."""
_SPEED_TYPES = (0.0, 1.0)
"""SPEED_TYPE of the air speed and of the ground speed, for which older versions of pymavlink have no names."""


class ItemError(ValueError):
    """An item is not accepted.

    Args:
        result: the MAV_MISSION_RESULT with which it is refused.
        message: what is wrong.
    """

    def __init__(self, result: int, message: str) -> None:
        super().__init__(message)
        self.result = result


@dataclass(frozen=True)
class HomePosition:
    """One place in the global frame and in the autopilot's local frame."""

    latitude: float
    """[deg]."""
    longitude: float
    """[deg]."""
    altitude: float
    """Above mean sea level [m]."""
    ned: tuple[float, float, float]
    """[m]."""

    @classmethod
    def from_message(cls, message: Any) -> HomePosition | None:
        """Return the place of a HOME_POSITION; None if it is not finite."""
        ned = message.x, message.y, message.z
        if not all(map(math.isfinite, ned)):
            return None
        return cls(1e-7 * message.latitude, 1e-7 * message.longitude, 1e-3 * message.altitude, ned)

    def to_ned(self, latitude: float, longitude: float, height: float) -> tuple[float, float, float]:
        """Return a place in the local frame [m].

        On a plane that touches the earth at home: 1 km away, the error is below 0.1 m up to a latitude of 60 degrees.

        Args:
            latitude, longitude: [deg].
            height: above home [m].
        """
        north, east, down = self.ned
        turn = (longitude - self.longitude + 180.0) % 360.0 - 180.0  # the shorter way around
        mean = math.radians(0.5 * (latitude + self.latitude))
        east += _EARTH_RADIUS * math.cos(mean) * math.radians(turn)
        return north + _EARTH_RADIUS * math.radians(latitude - self.latitude), east, down - height


class ItemReader:
    """Collects the items of one mission.

    Args:
        dialect: pymavlink's module of messages.
        home: the place of home; None if it is unknown, and items in global frames are refused.

    Attributes:
        numbers: numbers of the items that are waypoints.
    """

    def __init__(self, dialect: Any, home: HomePosition | None) -> None:
        self.numbers: list[int] = []
        self._dialect, self._home = dialect, home
        self._waypoints: list[Waypoint] = []
        self._speed: float | None = None

    def add(self, item: Any) -> None:
        """Add a MISSION_ITEM_INT; raises ItemError."""
        d = self._dialect
        if item.command == d.MAV_CMD_DO_CHANGE_SPEED:
            self._change_speed(item)
        elif item.command == d.MAV_CMD_NAV_WAYPOINT:
            self._add_waypoint(item)
        else:
            raise ItemError(
                d.MAV_MISSION_UNSUPPORTED,
                f"the command {item.command} is not flown; send MAV_CMD_NAV_WAYPOINT or MAV_CMD_DO_CHANGE_SPEED.",
            )

    def mission(self) -> Mission:
        """Return the mission, which ends with a stop; raises ItemError if it has no waypoints."""
        if not self._waypoints:
            raise ItemError(self._dialect.MAV_MISSION_INVALID, "it is the last one, and there is no waypoint.")
        return Mission((*self._waypoints[:-1], dataclasses.replace(self._waypoints[-1], stop=True)))

    def _change_speed(self, item: Any) -> None:
        d = self._dialect
        if item.param1 not in _SPEED_TYPES:
            raise ItemError(d.MAV_MISSION_INVALID_PARAM1, "only the air speed or the ground speed can be changed.")
        if item.param2 == -1.0:  # no change
            return
        if item.param2 == -2.0:  # the default
            self._speed = None
            return
        try:
            self._speed = Waypoint((0.0, 0.0, 0.0), speed=item.param2).speed
        except ValueError as error:
            raise ItemError(d.MAV_MISSION_INVALID_PARAM2, str(error)) from error

    def _add_waypoint(self, item: Any) -> None:
        d = self._dialect
        if not item.autocontinue:
            raise ItemError(d.MAV_MISSION_UNSUPPORTED, "a mission cannot wait for a command; set autocontinue.")
        if item.param3 and not math.isnan(item.param3):
            raise ItemError(d.MAV_MISSION_INVALID_PARAM3, "waypoints are not passed at a distance; set the radius 0.")
        waypoint = Waypoint(as_position(world_from_ned(self._place(item))), speed=self._speed)
        hold, radius = (0.0 if math.isnan(value) else value for value in (item.param1, item.param2))
        for changes, result in (
            ({"stop": True, "hold": hold} if hold else {}, d.MAV_MISSION_INVALID_PARAM1),
            ({"radius": radius} if radius else {}, d.MAV_MISSION_INVALID_PARAM2),
        ):
            try:
                waypoint = dataclasses.replace(waypoint, **changes)
            except ValueError as error:
                raise ItemError(result, str(error)) from error
        self._waypoints.append(waypoint)
        self.numbers.append(item.seq)

    def _place(self, item: Any) -> tuple[float, float, float]:
        """Return the place of a waypoint in the autopilot's local frame [m]; raises ItemError."""
        d = self._dialect
        if not math.isfinite(item.z):
            raise ItemError(d.MAV_MISSION_INVALID_PARAM7, "the height is not a finite number.")
        if item.frame == d.MAV_FRAME_LOCAL_NED:
            return 1e-4 * item.x, 1e-4 * item.y, item.z
        is_relative = item.frame in (d.MAV_FRAME_GLOBAL_RELATIVE_ALT, d.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT)
        if not is_relative and item.frame not in (d.MAV_FRAME_GLOBAL, d.MAV_FRAME_GLOBAL_INT):
            raise ItemError(d.MAV_MISSION_UNSUPPORTED_FRAME, f"the frame {item.frame} is neither local NED nor global.")
        if self._home is None:
            raise ItemError(
                d.MAV_MISSION_UNSUPPORTED_FRAME,
                "it is in a global frame, and the autopilot has sent no HOME_POSITION; wait for it, or use local NED.",
            )
        latitude, longitude = 1e-7 * item.x, 1e-7 * item.y
        if not abs(latitude) <= 90.0:
            raise ItemError(d.MAV_MISSION_INVALID_PARAM5_X, f"the latitude is {latitude:g}; it must be within 90 deg.")
        if not abs(longitude) <= 180.0:
            raise ItemError(
                d.MAV_MISSION_INVALID_PARAM6_Y, f"the longitude is {longitude:g}; it must be within 180 deg."
            )
        return self._home.to_ned(latitude, longitude, item.z - (0.0 if is_relative else self._home.altitude))
