"""Quintic polynomials: the guides, and what following them asks for."""

# Postponed annotations are left out: Warp structs need the types themselves.

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class Quintic:
    """Coefficients a_0 .. a_5 of a guide, world frame, SI units, and its duration T [s]."""

    a0: wp.vec3
    a1: wp.vec3
    a2: wp.vec3
    a3: wp.vec3
    a4: wp.vec3
    a5: wp.vec3
    T: float


@wp.func
def quintic(p0: wp.vec3, v0: wp.vec3, acceleration0: wp.vec3, p1: wp.vec3, v1: wp.vec3, T: float) -> Quintic:
    """Return the quintic from (p0, v0, acceleration0) at time 0 to (p1, v1, 0) at time T, in closed form."""
    dp = p1 - p0 - T * v0 - (0.5 * T * T) * acceleration0
    dv = T * (v1 - v0 - T * acceleration0)
    da = (-0.5 * T * T) * acceleration0
    T3 = T * T * T
    c = Quintic()
    c.a0 = p0
    c.a1 = v0
    c.a2 = 0.5 * acceleration0
    c.a3 = (10.0 * dp - 4.0 * dv + da) / T3
    c.a4 = (-15.0 * dp + 7.0 * dv - 2.0 * da) / (T3 * T)
    c.a5 = (6.0 * dp - 3.0 * dv + da) / (T3 * T * T)
    c.T = T
    return c


@wp.func
def guide_position(c: Quintic, s: float) -> wp.vec3:
    """Return the position of a guide at time s; past its end, it stays there."""
    s = wp.min(s, c.T)
    return c.a0 + s * (c.a1 + s * (c.a2 + s * (c.a3 + s * (c.a4 + s * c.a5))))


@wp.struct
class GuideForce:
    """Coefficients of the force per mass that follows a guide, b0 + b1 s + .. + b4 s^4 [m/s^2], world frame."""

    b0: wp.vec3
    b1: wp.vec3
    b2: wp.vec3
    b3: wp.vec3
    b4: wp.vec3


@wp.func
def guide_force(c: Quintic, g: wp.vec3, drag: float) -> GuideForce:
    """Return a - g + drag v along a guide; g is the acceleration without control and drag [m/s^2]."""
    f = GuideForce()
    f.b0 = 2.0 * c.a2 + drag * c.a1 - g
    f.b1 = 6.0 * c.a3 + (2.0 * drag) * c.a2
    f.b2 = 12.0 * c.a4 + (3.0 * drag) * c.a3
    f.b3 = 20.0 * c.a5 + (4.0 * drag) * c.a4
    f.b4 = (5.0 * drag) * c.a5
    return f


@wp.func
def force_at(f: GuideForce, s: float) -> wp.vec3:
    """Return the force per mass at time s of a guide."""
    return f.b0 + s * (f.b1 + s * (f.b2 + s * (f.b3 + s * f.b4)))
