"""Warp kernels of the simulated sensor: beam directions over time, and scans with noise and dropout."""

# Postponed annotations are left out: kernels made for a case refer to local names.

import functools

import warp as wp

from aero_viz.scenes.geometry import Geometry
from aero_viz.scenes.triangles import mesh_range
from aero_viz.sensors.raycast import ray_range

wp.set_module_options({"enable_backward": False})

# Steps of the two-dimensional low-discrepancy sequence R2 (Roberts 2018), 1 / rho and 1 / rho^2 with rho the plastic
# number, in units of 2^-32: integer overflow yields the fractional part, exactly for every index.
STEP_AZIMUTH = wp.constant(wp.uint32(3242174889))
STEP_ELEVATION = wp.constant(wp.uint32(2447445414))
INVERSE_2_24 = wp.constant(2.0**-24)


@wp.struct
class Beams:
    """`LidarModel` for kernels."""

    elevation_min: float
    """[rad]"""
    elevation_max: float
    height_min: float
    """Sine of elevation_min; equal steps of the sine are equal steps of solid angle."""
    height_max: float
    azimuth_start: float
    """Azimuth of the first ray of a turn: 0 if the turn is complete, else the right edge of the field of view [rad]."""
    azimuth_width: float
    """Angle of a turn [rad]."""
    masked_below: float
    """Rays of a complete turn at a smaller azimuth than this [rad], or a larger one than the next, return nothing."""
    masked_above: float
    points_per_sweep: int
    rays: float
    """Mean number of rays in a sweep of the first sensor of the drone."""
    sweep_rate: float
    """That of the first sensor [Hz]."""
    salt: int
    """Separates the random numbers of this sensor from those of others on the drone; 0 for the first one."""
    range_min: float
    range_max: float
    range_noise: float
    dropout: float
    strays: float
    """Fraction of the rays that end in the air within the next, evenly distributed in a ball."""
    stray_range: float
    rings: int
    """Number of rings; 0 for another pattern."""
    image_rows: int
    """Number of rows of an image; 0 for another pattern."""
    tilt: float
    """Tilt of the outer beams of a Livox [rad]; 0 for another pattern."""
    turn_step: wp.uint32
    """Rotation of a Livox from one shot of its four beams to the next, in units of 2^-32 turns."""
    swing_step: wp.uint32
    """Advance of its swing over the field of view per shot, in units of 2^-32 periods."""
    mount_position: wp.vec3
    mount_attitude: wp.quat
    """Rotation from sensor to body."""


@wp.struct
class Poses:
    """Poses of B vehicles at the beginning and at the end of a scan, world frame; they move evenly in between."""

    position_before: wp.array(dtype=wp.vec3)  # [B]
    position: wp.array(dtype=wp.vec3)  # [B]
    quaternion_before: wp.array(dtype=wp.vec4)  # [B], w, x, y, z
    quaternion: wp.array(dtype=wp.vec4)  # [B]


@wp.func
def position_at(poses: Poses, b: int, share: float):
    """Return the position at a share of the scan."""
    return wp.lerp(poses.position_before[b], poses.position[b], share)


@wp.func
def fraction(index: wp.uint32, step: wp.uint32):
    """Return the fractional part of index * step / 2^32."""
    return float((index * step) >> wp.uint32(8)) * INVERSE_2_24


@wp.func
def beam_direction(beams: Beams, index: int, phase: wp.uint32):
    """Return the unit direction of a ray in the sensor frame; `index` counts rays over all sweeps."""
    azimuth = float(0.0)
    height = float(0.0)
    i = (index % beams.points_per_sweep + beams.points_per_sweep) % beams.points_per_sweep
    if beams.image_rows > 0:
        columns = beams.points_per_sweep // beams.image_rows
        left = wp.tan(beams.azimuth_start + beams.azimuth_width)
        right = wp.tan(beams.azimuth_start)
        top = wp.tan(beams.elevation_max)
        bottom = wp.tan(beams.elevation_min)
        across = (float(i % columns) + 0.5) / float(columns)
        down = (float(i // columns) + 0.5) / float(beams.image_rows)
        return wp.normalize(wp.vec3(1.0, left + across * (right - left), top + down * (bottom - top)))
    if beams.rings > 0:
        ring = i % beams.rings
        azimuth = float(i - ring) / float(beams.points_per_sweep)
        share = float(ring) / float(wp.max(beams.rings - 1, 1))
        height = wp.sin(beams.elevation_min + share * (beams.elevation_max - beams.elevation_min))
    elif beams.tilt > 0.0:
        k = wp.uint32(index) + phase
        shot = k / wp.uint32(4)
        weight = 1.0 - float(k % wp.uint32(4)) / 1.5
        azimuth = fraction(shot, beams.turn_step)
        middle = 0.5 * (beams.elevation_min + beams.elevation_max)
        reach = beams.elevation_max - middle - beams.tilt
        swing = reach * wp.cos(2.0 * wp.pi * fraction(shot, beams.swing_step))
        height = wp.sin(middle + swing + weight * beams.tilt * wp.cos(2.0 * wp.pi * azimuth))
    else:
        k = wp.uint32(index) + phase
        azimuth = fraction(k, STEP_AZIMUTH)
        height = beams.height_min + fraction(k, STEP_ELEVATION) * (beams.height_max - beams.height_min)
    flat = wp.sqrt(wp.max(1.0 - height * height, 0.0))
    angle = beams.azimuth_start + beams.azimuth_width * azimuth
    return wp.vec3(flat * wp.cos(angle), flat * wp.sin(angle), height)


@wp.func
def is_masked(beams: Beams, ray: wp.vec3) -> bool:
    """Return True if a ray, in the sensor frame, is beside the field of view."""
    if beams.masked_below <= -wp.pi and beams.masked_above >= wp.pi:
        return False
    azimuth = wp.atan2(ray[1], ray[0])
    return azimuth < beams.masked_below or azimuth > beams.masked_above


@wp.func
def attitude_at(poses: Poses, b: int, share: float):
    """Return the attitude at a share of the scan, as a Warp quaternion x, y, z, w."""
    before = poses.quaternion_before[b]
    after = poses.quaternion[b]
    sign = wp.where(wp.dot(before, after) < 0.0, -1.0, 1.0)
    q = wp.normalize((1.0 - share) * before + (share * sign) * after)
    return wp.quat(q[1], q[2], q[3], q[0])


@functools.cache
def scan(with_triangles: bool) -> wp.Kernel:
    """Return the kernel that measures a part of a sweep in worlds with or without triangles.

    The query of triangles takes many registers, which are scarce on CUDA, and few worlds need it.
    """

    # Limits the registers so that a multiprocessor holds four blocks; without the limit it holds two.
    @wp.kernel(module="unique", enable_backward=False, launch_bounds=(256, 4))
    def scan(
        # problem
        geometry: Geometry,
        world: wp.array(dtype=int),  # [B]
        beams: Beams,
        seeds: wp.array(dtype=int),  # [B]
        sweep: int,
        start: int,
        first: int,
        count: int,
        offset: int,
        # in
        active: wp.array(dtype=int),  # [B]
        lost: wp.array(dtype=int),  # [B]
        poses: Poses,
        estimated: Poses,
        # out
        points: wp.array2d(dtype=wp.vec3),  # [B, rays_per_sweep]
    ):
        """Measure rays of a sweep from the true poses, and place their points by the estimated poses.

        `start` rays of the sensor were fired before the sweep. `count` of the sweep, from `first` on, give the points
        from `offset` on.
        """
        b, i = wp.tid()
        if active[b] == 0:
            return
        index = start + first + i
        seed = seeds[b] ^ beams.salt
        share = (float(i) + 0.5) / float(count)
        ray = beam_direction(beams, index, wp.rand_init(seed))
        beam = wp.quat_rotate(beams.mount_attitude, ray)
        attitude = attitude_at(poses, b, share)
        origin = position_at(poses, b, share) + wp.quat_rotate(attitude, beams.mount_position)
        direction = wp.quat_rotate(attitude, beam)
        time = (float(sweep) + (float(first + i) + 0.5) / beams.rays) / beams.sweep_rate
        triangle = float(wp.inf)
        if wp.static(with_triangles):
            triangle = mesh_range(geometry.meshes[world[b]], origin, direction, beams.range_max)
        distance = ray_range(geometry, world[b], origin, direction, triangle, beams.range_max, time)
        point = wp.vec3(wp.nan, wp.nan, wp.nan)
        chance = wp.rand_init(seed, index)
        if beams.strays > 0.0 and wp.randf(chance) < beams.strays:
            distance = wp.min(distance, beams.stray_range * wp.pow(wp.randf(chance), 1.0 / 3.0))
        if is_masked(beams, ray):
            distance = wp.inf
        is_in_range = distance <= beams.range_max and distance >= beams.range_min
        if lost[b] == 0 and is_in_range and wp.randf(chance) >= beams.dropout:
            in_body = beams.mount_position + (distance + beams.range_noise * wp.randn(chance)) * beam
            place = wp.quat_rotate(attitude_at(estimated, b, share), in_body)
            point = position_at(estimated, b, share) + place
        points[b, offset + i] = point

    return scan
