/* The AERO-MPPI planner without Python: replays the kernel launches that `aero-planner export` has captured.
 *
 * SI units. World frame: x forward, y left, z up. Quaternions are in the order w, x, y, z and rotate vectors from the body
 * to the world frame. Only one thread at a time may use a planner; different threads may use different planners.
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
    double time;           /* stamp [s]; NaN: one sampling.replan_period after the previous state */
    float position[3];     /* p [m] */
    float velocity[3];     /* v [m/s] */
    float quaternion[4];   /* q; need not be normalised */
    float acceleration[3]; /* a [m/s^2], measured; all NaN: unknown, and no disturbance is estimated */
} aero_state;

typedef struct aero_goal {
    float position[3];   /* p_goal [m] */
    float velocity[3];   /* v_goal [m/s]; all NaN: zero, arrive and stop */
    float quaternion[4]; /* q_goal; all NaN: level, with the nose toward the goal */
} aero_goal;

typedef enum aero_status {
    AERO_OK = 0,
    AERO_NO_SAFE_CANDIDATE = 1, /* the command brakes, or keeps the largest clearance where no stop is clear */
    AERO_STALE_CLOUD = 2        /* the cloud is older than partition.cloud_age_max, or empty as long; it brakes */
} aero_status;

typedef struct aero_sizes {
    int32_t instances; /* M */
    int32_t rows;      /* R >= M: in the arrays, the candidates that stop follow the instances */
    int32_t steps;     /* N */
    int32_t points;    /* largest number of points of a cloud */
} aero_sizes;

/* Load a planner from the folder of a bundle, for a device such as "cpu" or "cuda:0". The bundle must be for this
 * version of Warp, and for this CPU or the architecture of this GPU.
 *
 * Returns NULL on failure, and writes one sentence about it to `problem`, a buffer of `room` bytes or NULL.
 */
aero_planner* aero_open(const char* folder, const char* device, char* problem, size_t room);

/* Free a planner; NULL is allowed. */
void aero_close(aero_planner* planner);

aero_sizes aero_get_sizes(const aero_planner* planner);

/* Plan once, and wait for the result. `points` are `count` x 3 [m], world frame; points that are not finite are
 * dropped. `cloud_age` is the time since they were measured [s]. Everything below `ground_height` [m], world frame,
 * counts as an obstacle; -INFINITY if the ground is unknown. `aero-planner run` passes limits.fence_height_min.
 *
 * Returns 0, or -1 if an input is not finite or too large, a quaternion is zero, there are too many points, or the
 * device failed. There is no new plan then, and `aero_problem` returns the reason.
 */
int aero_plan(aero_planner* planner, const aero_state* state, const aero_goal* goal, const float* points,
              int32_t count, float cloud_age, float ground_height);

/* Return one sentence about the last call that failed. */
const char* aero_problem(const aero_planner* planner);

/* Return the safety of the last plan. The controls of aero_command may be flown in any case. */
aero_status aero_get_status(const aero_planner* planner);

/* Return the index of the instance that the last plan flies, a row of the arrays. If a candidate that stops has replaced
 * it, the row holds its controls, rollout, clearance and costs. The array "flown" has the row of that candidate, and of
 * its guide.
 */
int32_t aero_get_best(const aero_planner* planner);

/* Return the controls to fly, N x 4, those of vehicle.model: for ctbr thrust [N] and body rates [rad/s]. Call it after
 * each plan; the pointer is valid until the next one. Returns NULL if they can't be copied.
 */
const float* aero_command(aero_planner* planner);

/* Return an array of the graph by its name in Python (`Planner.outputs`): "controls" R x N x 4,
 * "positions" R x (N + 1) x 3, "velocities" R x (N + 1) x 3, "quaternions" R x (N + 1) x 4, "stage2_cost" R,
 * "goal_cost" R, "collision_cost" R, "clearance" R x N, and so on. Call it after each plan; the pointer is valid until
 * the next one. From a GPU, the array is copied on this call.
 *
 * Writes the size in bytes to `size` unless it is NULL. Returns NULL if there is no such array, or it can't be copied.
 */
const void* aero_array(aero_planner* planner, const char* name, size_t* size);

/* Discard the previous plan and restart the noise sequence from a seed. Returns 0, or -1 if the device failed. */
int aero_reset(aero_planner* planner, int32_t seed);

#ifdef __cplusplus
}
#endif

#endif
