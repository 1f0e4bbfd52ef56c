"""What the hooks of stages get and return, see `aero_planner.stage.Hooks`."""

# Postponed annotations are left out: Warp structs need the types themselves.

import warp as wp


@wp.struct
class Estimate:
    """What the vehicle model does not explain, and what is made of it, world frame [m/s^2]."""

    since: float  # time since the previous plan [s]; NaN without one
    horizon: float  # length of the horizon, T [s]
    velocity: wp.vec3  # [m/s]
    measured: wp.vec3  # acceleration; NaN: unknown
    modelled: wp.vec3  # acceleration by the model at the control in effect, without disturbance and drag
    given: wp.vec3  # disturbance that the caller states; NaN: unknown
    acting: wp.vec3  # disturbance that acts now, for the prediction of the state
    fed_forward: wp.vec3  # disturbance that plans count on
    drag: float  # drag that plans count on [1/s]


@wp.struct
class Spread:
    """Spacing of the anchors."""

    p: wp.vec3  # position of the drone, world frame [m]
    speed: float  # [m/s]
    columns: float  # factor on the spacing of the columns
    rows: float  # factor on the spacing of the rows
    clip: int  # 1 if guides end in front of what their cells measured


@wp.struct
class Fallback:
    """What is flown if no instance is admissible."""

    status: int  # `PlanStatus`, not OK
    flown: int  # row that is flown
    clearance: wp.vec2  # of that row, see `Scores.least_clearance`
