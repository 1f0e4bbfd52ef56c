"""Estimate of the acceleration that the vehicle model does not explain: drag, and the mean of the rest."""

# Postponed annotations are left out: Warp structs need the types themselves.

from typing import Any

import warp as wp

from aero_planner.device.hook_records import Estimate
from aero_planner.device.lag import lag_share

wp.set_module_options({"enable_backward": False})

_LARGEST_DRAG = wp.constant(0.5)
"""Largest drag that is believed [1/s]."""
_HALF_BELIEVED_SPEED = wp.constant(1.0)
"""Speed of flights at which half of the estimated drag is believed [m/s]: slow flights hardly show it."""
_LARGEST_DISTURBANCE = wp.constant(3.0)
"""Largest unexplained acceleration that is believed [m/s^2]: the drone may not fly what was planned."""


@wp.struct
class DisturbanceMeans:
    """Means of what the model does not explain."""

    mean_disturbance: wp.array(dtype=wp.vec3)  # [B], world frame [m/s^2]
    drag_means: wp.array(dtype=wp.vec2)  # [B], means of -a v and of v^2, the ratio of which is the drag


@wp.func
def clamp_disturbance(d: wp.vec3) -> wp.vec3:
    """Return a disturbance, shortened to `_LARGEST_DISTURBANCE`."""
    return (_LARGEST_DISTURBANCE / wp.max(wp.length(d), _LARGEST_DISTURBANCE)) * d


@wp.func
def drag_sample(unexplained: wp.vec3, v: wp.vec3) -> wp.vec2:
    """Return -a v and v^2 of an unexplained acceleration a; their means have the drag as their ratio.

    This is the least-squares estimate of k in a = -k v. A drag beyond `_LARGEST_DRAG` is not believed.
    """
    square = wp.dot(v, v)
    return wp.vec2(wp.clamp(-wp.dot(unexplained, v), -_LARGEST_DRAG * square, _LARGEST_DRAG * square), square)


@wp.func
def without_tail_component(mean: wp.vec3, v: wp.vec3) -> wp.vec3:
    """Return a disturbance without its component against the velocity.

    It shortens every stop, and may end with the motion. It is left as a margin.
    """
    against = wp.min(wp.dot(mean, v), 0.0) / wp.max(wp.dot(v, v), 1.0e-6)
    return mean - against * v


@wp.func
def estimate(b: int, e: Estimate, views: Any, c: Any) -> Estimate:
    """Estimate disturbance and drag, see `Hooks.estimate`.

    What the model does not explain is the difference of the measured acceleration from the modelled one, or is given.
    Its part against the velocity, in proportion to it, is the drag; the mean of the rest is the disturbance. Both are 0
    in the first plan, and the disturbance also after a horizon without a plan or without an acceleration.
    """
    unexplained = e.given
    is_given = not wp.isnan(unexplained[0])
    if not is_given and e.since < e.horizon:  # NaN without an acceleration
        unexplained = e.measured - e.modelled
    is_known = not wp.isnan(unexplained[0]) and (is_given or e.since >= 0.0)
    means = wp.vec2(0.0, 0.0)
    if e.since >= 0.0:
        means = views.disturbance.drag_means[b]
    drag = float(0.0)
    if c.drag_time > 0.0:
        if is_known and e.since >= 0.0:
            means += (1.0 - lag_share(c.drag_time, e.since)) * (drag_sample(unexplained, e.velocity) - means)
        drag = wp.max(means[0], 0.0) / (means[1] + _HALF_BELIEVED_SPEED * _HALF_BELIEVED_SPEED)
    views.disturbance.drag_means[b] = means
    disturbance = wp.vec3(0.0, 0.0, 0.0)
    if c.disturbance_time > 0.0 and is_known:
        disturbance = clamp_disturbance(unexplained + drag * e.velocity)
        if not is_given:
            mean_before = views.disturbance.mean_disturbance[b]
            share = 1.0 - lag_share(c.disturbance_time, e.since)
            disturbance = mean_before + share * (disturbance - mean_before)
    views.disturbance.mean_disturbance[b] = disturbance
    e.acting = disturbance
    e.fed_forward = without_tail_component(disturbance, e.velocity)
    e.drag = drag
    return e
