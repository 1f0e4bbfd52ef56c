"""Operations and latency of the planner's equations, counted by evaluating them with numbers that have no value.

Every result knows the earliest cycle at which it can be available if independent operations run at the same time. A
product that is added to a number is one fused instruction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Latency:
    """Latency of operations [cycles]."""

    arithmetic: int
    """Addition, product, fused product and sum, comparison."""
    special: int
    """Square root, its inverse, quotient, exponential."""


@dataclass
class Count:
    """Operations and latency of a computation."""

    latency: Latency
    operations: int = 0
    """Additions, products, comparisons, roots, quotients and exponentials."""
    cycles: int = 0
    """Latest result."""
    numbers: list[Real] = field(default_factory=list, repr=False)

    def inputs(self, size: int) -> list[Real]:
        """Return numbers that are available from the start."""
        return [Real(self, 0) for _ in range(size)]

    def result(self, ready: int, factors: int | None = None) -> Real:
        """Count one operation, with its result at cycle `ready`."""
        self.operations += 1
        self.cycles = max(self.cycles, ready)
        return Real(self, ready, factors)


class Real:
    """Number without a value, which counts the operations on it.

    Args:
        count: counter of the operations.
        ready: cycle at which the number is available.
        factors: for a product, the cycle at which its factors are available.
    """

    def __init__(self, count: Count, ready: int, factors: int | None = None) -> None:
        self._count, self.ready, self._factors = count, ready, factors

    def _ready(self, other: Real | float) -> int:
        return max(self.ready, other.ready if isinstance(other, Real) else 0)

    def __mul__(self, other: Real | float) -> Real:
        known = self._ready(other)
        return self._count.result(known + self._count.latency.arithmetic, known)

    def __add__(self, other: Real | float) -> Real:
        fused = [self._ready(other)]
        if self._factors is not None:
            fused.append(max(self._factors, other.ready if isinstance(other, Real) else 0))
        if isinstance(other, Real) and other._factors is not None:
            fused.append(max(other._factors, self.ready))
        return self._count.result(min(fused) + self._count.latency.arithmetic)

    __rmul__, __radd__, __sub__, __rsub__ = __mul__, __add__, __add__, __add__

    def special(self) -> Real:
        """Return the result of a root, an inverse root or a similar operation."""
        return self._count.result(self.ready + self._count.latency.special)

    def clamp(self) -> Real:
        """Return the number clamped on both sides."""
        return (self + 0.0) + 0.0


Vector = list[Real]

_ARC_TERMS = 6
"""Coefficients of a polynomial for the arctangent in float32."""


def _dot(a: Sequence[Real | float], b: Sequence[Real]) -> Real:
    products: list[Real] = [y * x for x, y in zip(a, b, strict=True)]
    return _sum(products)


def _sum(terms: Sequence[Real]) -> Real:
    """Return the sum of numbers, added as a tree."""
    terms = list(terms)
    while len(terms) > 1:
        terms = [terms[i] + terms[i + 1] if i + 1 < len(terms) else terms[i] for i in range(0, len(terms), 2)]
    return terms[0]


def _length(a: Vector) -> Real:
    return _dot(a, a).special()


def _difference(a: Vector, b: Vector) -> Vector:
    return [x - y for x, y in zip(a, b, strict=True)]


def _cross(a: Vector, b: Vector) -> Vector:
    return [_dot([a[i], a[j]], [b[j], b[i]]) for i, j in ((1, 2), (2, 0), (0, 1))]


def _q_rate(q: Vector, omega: Vector) -> Vector:
    """Return 1/2 q (x) [0, omega]; omega includes the factor 1/2."""
    w, x, y, z = q
    a, b, c = omega
    return [
        _dot([x, y, z], [a, b, c]),
        _dot([w, y, z], [a, c, b]),
        _dot([w, z, x], [b, a, c]),
        _dot([w, x, y], [c, b, a]),
    ]


def _axis(q: Vector) -> Vector:
    """Return R(q) e_3 for q scaled by the square root of 2."""
    w, x, y, z = q
    return [_dot([x, w], [z, y]), _dot([y, w], [z, x]), 1.0 - _dot([x, y], [x, y])]


def _step_attitude(q: Vector, omega: Vector) -> Vector:
    """Return q after a time step: q and its rate times polynomials in |omega|^2, normalised."""
    s = _dot(omega, omega)
    attitude_factor, rate_factor = s * (s * 1.0 + 1.0) + 1.0, s * 1.0 + 1.0
    rate = _q_rate(q, omega)
    q = [rate_factor * r + attitude_factor * x for x, r in zip(q, rate, strict=True)]
    inverse = _dot(q, q).special()
    return [x * inverse for x in q]


def _step(p: Vector, v: Vector, q: Vector, u: Vector) -> tuple[Vector, Vector, Vector]:
    """Return the state after one Runge-Kutta step."""
    thrust, omega = u[0], u[1:]
    stage, accelerations = q, [_axis(q)]
    for _ in range(3):
        stage = [x + r * 1.0 for x, r in zip(q, _q_rate(stage, omega), strict=True)]
        accelerations.append(_axis(stage))
    a = [[x * thrust + 0.0 for x in axis] for axis in accelerations]
    p = [p[i] + v[i] * 1.0 + ((a[0][i] + a[1][i]) + a[2][i]) * 1.0 for i in range(3)]
    v = [v[i] + ((a[0][i] + a[3][i]) + (a[1][i] + a[2][i]) * 1.0) * 1.0 for i in range(3)]
    return p, v, _step_attitude(q, omega)


def rollout(latency: Latency, steps: int, *, noisy: bool = True) -> Count:
    """Count one rollout of N time steps with all costs except the clearance; without noise it is one of Stage II."""
    n = Count(latency)
    p, v, q, p_goal, v_goal, q_goal = (n.inputs(size) for size in (3, 3, 4, 3, 3, 4))
    noise, before = n.inputs(4), n.inputs(4)
    costs: list[Real] = []
    for t in range(steps):
        u = n.inputs(4)
        if noisy:
            noise = [x * 1.0 + fresh * 1.0 for x, fresh in zip(noise, n.inputs(4), strict=True)]
            u = [(x + e * 1.0).clamp() for x, e in zip(u, noise, strict=True)]
            change = _difference(u, before)
            costs += [_dot(u, u) * 1.0, _dot(change, change) * 1.0] if 0 < t < steps - 1 else []
            before = u
        p, v, q = _step(p, v, q, u)
        e = _q_rate(q, q_goal[1:])[1:]
        terms = [_length(_difference(p, p_goal)), _length(_difference(v, v_goal)), _length(e)]
        excess = _length(v) + 0.0
        terms.append(excess * excess)
        if noisy:
            terms += [_length(_difference(p, n.inputs(3))), _dot(v, v)]
        costs += [term * 1.0 for term in terms]
    _sum(costs)
    return n


def nominal_controls(latency: Latency, steps: int) -> Count:
    """Count one guide and its nominal controls; the attitude of each time step depends on the previous one."""
    n = Count(latency)
    coefficients = [n.inputs(3) for _ in range(6)]
    q = n.inputs(4)
    for _ in range(steps):
        axis = []
        for i in range(3):
            a = coefficients[5][i]
            for power in (4, 3, 2):
                a = a * 1.0 + coefficients[power][i]
            axis.append(a)
        inverse = _dot(axis, axis).special()
        axis = [x * inverse for x in axis]
        cross = _cross(q[1:], axis)
        z = [x + q[0] * a + b for x, a, b in zip(axis, cross, _cross(q[1:], cross), strict=True)]
        sine = _length(z[:2])
        angle = (sine * z[2].special()) * 1.0
        for _ in range(_ARC_TERMS):  # polynomial of the arctangent
            angle = angle * 1.0 + 1.0
        gain = angle * sine.special()
        u = [_dot(axis, _axis(q)).clamp(), (gain * z[1]).clamp(), (gain * z[0]).clamp(), n.inputs(1)[0]]
        q = _step_attitude(q, u[1:])
    return n


def partition_point(latency: Latency) -> Count:
    """Count range and cell of one point, with two arctangents."""
    n = Count(latency)
    d = _difference(n.inputs(3), n.inputs(3))
    _length(d)
    body = [_dot(row, d) for row in (n.inputs(3), n.inputs(3), n.inputs(3))]
    for y, x in ((body[1], body[0]), (body[2], _length(body[:2]))):
        angle = y * x.special()
        square = angle * angle
        series = square * 1.0 + 1.0
        for _ in range(_ARC_TERMS - 1):
            series = series * square + 1.0
        _ = (angle * series) * 1.0 + 1.0
    return n
