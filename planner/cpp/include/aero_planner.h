/* The AERO-MPPI planner without Python: replays a plan that `aero-planner export` has captured.
 *
 * World frame: x forward, y left, z up. Quaternions are w, x, y, z and turn the body frame into the world frame. SI units.
 * A planner belongs to one thread at a time; several planners in several threads are fine.
 */
#ifndef AERO_PLANNER_H
#define AERO_PLANNER_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

typedef struct aero_planner aero_planner;

typedef struct aero_state {
    double time;           /* stamp [s]; NaN: one sampling.replan_period after the state before */
    float position[3];     /* p [m] */
    float velocity[3];     /* v [m/s] */
    float quaternion[4];   /* q; need not be normalised */
    float acceleration[3]; /* a [m/s^2] */
} aero_state;

typedef struct aero_goal {
    float position[3];   /* p_goal [m] */
    float velocity[3];   /* v_goal [m/s]; all NaN: zero, arrive and stop */
    float quaternion[4]; /* q_goal; all NaN: level, with the nose toward the goal */
} aero_goal;

typedef enum aero_status {
    AERO_OK = 0,
    AERO_NO_SAFE_CANDIDATE = 1, /* the command is a braking sequence */
    AERO_STALE_CLOUD = 2        /* the cloud is older than partition.cloud_age_max; the command brakes */
} aero_status;

typedef struct aero_sizes {
    int32_t instances; /* M */
    int32_t rows;      /* R >= M: arrays hold plain brakes behind the instances */
    int32_t steps;     /* N */
    int32_t points;    /* most points of a cloud */
} aero_sizes;

/* Load the graph of a bundle's folder for a device, "cpu" or "cuda:0". The bundle must be for this Warp, and for this CPU
 * or the architecture of this GPU.
 *
 * Returns NULL where it can't, and then writes one sentence to `problem`, which has room for `room` bytes (or is NULL).
 */
aero_planner* aero_open(const char* folder, const char* device, char* problem, size_t room);

/* Forget the planner; NULL is allowed. */
void aero_close(aero_planner* planner);

aero_sizes aero_get_sizes(const aero_planner* planner);

/* Plan once, and wait for it. `points` are `count` x 3 [m], world frame; those that are not finite are dropped.
 * `cloud_age` is the time since they were measured [s]. Everything below `ground_height` [m], world frame, counts as an
 * obstacle unless costs.use_ground is off; -INFINITY where the ground is unknown. `aero-planner run` gives
 * limits.fence_height_min.
 *
 * Returns 0, or -1 where an input is not finite, a quaternion is zero, there are more points than there is room for, or
 * the device failed; there is no new plan then, and `aero_problem` says why.
 */
int aero_plan(aero_planner* planner, const aero_state* state, const aero_goal* goal, const float* points,
              int32_t count, float cloud_age, float ground_height);

/* One sentence about the last call that failed. */
const char* aero_problem(const aero_planner* planner);

/* Whether the last plan may be flown; what aero_command returns always may. */
aero_status aero_get_status(const aero_planner* planner);

/* Index of the instance that the last plan flies, a row of the arrays. */
int32_t aero_get_best(const aero_planner* planner);

/* Controls to fly, N x 4: thrust [N], body rates [rad/s]. Ask after each plan; valid until the next one. */
const float* aero_command(aero_planner* planner);

/* An array of the graph by its name in Python (`Planner.outputs`): "controls" R x N x 4, "positions" R x (N + 1) x 3,
 * "velocities" R x (N + 1) x 3, "quaternions" R x (N + 1) x 4, "stage2_cost" R, "goal_cost" R, "collision_cost" R,
 * "clearance" R x N, ..
 * Ask after each plan; valid until the next one. From a GPU it is copied when it is asked for.
 *
 * Writes the size in bytes where `size` is not NULL; returns NULL where there is no such array, or it can't be copied.
 */
const void* aero_array(aero_planner* planner, const char* name, size_t* size);

/* Forget the previous plan and start the noise anew, from a seed. Returns 0, or -1 where the device failed. */
int aero_reset(aero_planner* planner, int32_t seed);

#ifdef __cplusplus
}
#endif

#endif
