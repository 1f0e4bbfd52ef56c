// The C interface of aero_planner.h, implemented with the graphs of graph.h.
#include "aero_planner.h"

#include "graph.h"
#include "version.h"
#include "warp.h"

#include <array>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <mutex>
#include <stdexcept>
#include <string>
#include <vector>

namespace {

constexpr float farthest = 1e6f; // largest value; float32 resolves a decimetre there, as in Python [m]
constexpr double farthest_return = 300.0; // no LiDAR of a drone sees farther, as in Python [m]

void start_warp()
{
    static std::mutex mutex;
    static bool started = false;
    const std::lock_guard<std::mutex> lock(mutex);
    if (!started && wp_init(WP_VERSION_STRING) != 0)
        throw std::runtime_error(
            std::string("Warp can't be started: ") + wp_get_error_string() + "; this program was built for Warp "
            WP_VERSION_STRING);
    started = true;
}

// Returns the number of a GPU, such as 1 for "cuda:1", or -1 for "cpu".
int find_gpu(const std::string& device)
{
    if (device == "cpu")
        return -1;
    int ordinal = -1, end = -1;
    std::sscanf(device.c_str(), "cuda:%d%n", &ordinal, &end);
    if (ordinal < 0 || end != static_cast<int>(device.size()))
        throw std::runtime_error("the device is '" + device + "'; it must be cpu or a GPU such as cuda:0");
    const int count = wp_cuda_device_get_count();
    if (ordinal >= count)
        throw std::runtime_error(
            device + " is not available; this version of Warp can use " + std::to_string(count) + " GPUs here");
    return ordinal;
}

Target read_target(const std::string& path, const char* export_option)
{
    std::ifstream file(path);
    std::string instances, features;
    Target target;
    if (!std::getline(file, target.warp) || !std::getline(file, instances))
        throw std::runtime_error(
            path + " can't be read; give the folder of a bundle made by 'aero-planner export' " + export_option);
    if (target.warp != WP_VERSION_STRING)
        throw std::runtime_error(
            "the bundle is for Warp " + target.warp + ", this program for " WP_VERSION_STRING
            "; export the bundle again with that version");
    target.instances = static_cast<int32_t>(std::strtol(instances.c_str(), nullptr, 10));
    if (std::getline(file, target.processor) && std::getline(file, features))
        target.processor += "\n" + features;
    return target;
}

template <class T> std::string bytes_of(T value) { return std::string(reinterpret_cast<const char*>(&value), sizeof value); }

// Reads lines of an array's name, the type of its numbers, and their initial value.
std::vector<State> read_state(const std::string& path)
{
    std::ifstream file(path);
    std::vector<State> states;
    std::string name, type, value;
    while (file >> name >> type >> value) {
        if (type == "float32")
            states.push_back({name, bytes_of(std::strtof(value.c_str(), nullptr))});
        else if (type == "float64")
            states.push_back({name, bytes_of(std::strtod(value.c_str(), nullptr))});
        else if (type == "int32")
            states.push_back({name, bytes_of(static_cast<int32_t>(std::strtol(value.c_str(), nullptr, 10)))});
        else
            throw std::runtime_error(path + " names the type '" + type + "'; export the bundle again");
    }
    if (states.empty())
        throw std::runtime_error(path + " can't be read; export the bundle again, or copy it whole");
    return states;
}

} // namespace

struct aero_planner {
    std::unique_ptr<Graph> graph;
    std::vector<State> states;
    aero_sizes sizes {};
    aero_status status = AERO_OK;
    int32_t best = 0;
    std::string problem;

    void open(const std::string& folder, const std::string& device)
    {
        start_warp();
        const int gpu = find_gpu(device);
        const std::string processor = gpu < 0 ? "cpu" : "sm_" + std::to_string(wp_cuda_device_get_arch(gpu));
        const std::string place = folder + "/graph/" + processor + "/";
        const Target target = read_target(
            place + "target.txt", gpu < 0 ? "--cpu" : "--arch on a machine with this GPU");
        states = read_state(place + "state.txt");
        graph = gpu < 0 ? open_cpu_graph(place + "planner", target) : open_cuda_graph(place + "planner", gpu);
        read_sizes(target.instances);
    }

    // Checks that the graph has the arrays of a planner for one drone, and derives the sizes from them.
    void read_sizes(int32_t instances)
    {
        const struct {
            const char* name;
            size_t bytes;
        } expected[] = {
            {"time", 8}, {"position", 12}, {"velocity", 12}, {"quaternion", 16}, {"acceleration", 12},
            {"disturbance", 12}, {"goal_position", 12}, {"goal_velocity", 12}, {"goal_quaternion", 16}, {"cloud_age", 4},
            {"is_blind", 4}, {"ground_height", 4}, {"point_count", 4}, {"best", 4}, {"status", 4}, {"flown", 4}, {"seed", 4},
        };
        bool fits = true;
        for (const auto& array : expected)
            fits &= graph->bytes(array.name) == array.bytes;
        for (const State& state : states)
            fits &= graph->bytes(state.name.c_str()) > 0 && graph->bytes(state.name.c_str()) % state.initial.size() == 0;
        const size_t row = graph->bytes("previous_controls"), rows = graph->bytes("stage2_cost") / sizeof(float);
        fits &= row > 0 && row % 16 == 0 && graph->bytes("controls") == rows * row && graph->bytes("points") >= 12;
        fits &= instances > 0 && static_cast<size_t>(instances) <= rows;
        fits &= graph->bytes("positions") == rows * (row / 16 + 1) * 12;
        if (!fits)
            throw std::runtime_error("the graph is not that of a planner for one drone; export it again");
        sizes.instances = instances;
        sizes.rows = static_cast<int32_t>(rows);
        sizes.steps = static_cast<int32_t>(row / 16);
        sizes.points = static_cast<int32_t>(graph->bytes("points") / 12);
    }

    template <class T> void put(const char* name, const T& value) { graph->put(name, &value, sizeof value); }

    template <class T> const T* get(const char* name) { return static_cast<const T*>(graph->get(name)); }

    void plan(const aero_state& state, const aero_goal& goal, const float* points, int32_t count, float cloud_age,
              float ground_height)
    {
        if (const char* mistake = find_mistake(state, goal, cloud_age, ground_height))
            throw std::runtime_error(mistake);
        if (count < 0 || count > sizes.points)
            throw std::runtime_error("the number of points is " + std::to_string(count) + ", but the graph takes 0 to " +
                                     std::to_string(sizes.points) + "; pass fewer points, or raise lidar.points_max, "
                                     "which with lidar.older_sweeps sets this number, and export again");
        put("time", state.time);
        put("position", state.position);
        put("velocity", state.velocity);
        put("quaternion", state.quaternion);
        put("acceleration", state.acceleration);
        put("disturbance", std::array<float, 3>{NAN, NAN, NAN}); // estimated from the acceleration
        put("goal_position", goal.position);
        put("goal_velocity", goal.velocity);
        put("goal_quaternion", goal.quaternion);
        put("cloud_age", cloud_age);
        put("is_blind", static_cast<int32_t>(!shows_something(points, count, state.position)));
        put("ground_height", ground_height);
        put("point_count", count);
        if (count)
            graph->put("points", points, sizeof(float) * 3 * static_cast<size_t>(count));
        graph->replay({"status", "best", "previous_controls"});
        status = static_cast<aero_status>(*get<int32_t>("status"));
        best = *get<int32_t>("best");
    }

    void reset(int32_t seed)
    {
        put("seed", seed);
        for (const State& state : states) {
            std::string values;
            while (values.size() < graph->bytes(state.name.c_str()))
                values += state.initial;
            graph->put(state.name.c_str(), values.data(), values.size());
        }
    }

    // Runs a task. Returns 0, or -1 if it throws; `problem` is then the exception's message.
    template <class Task> int attempt(Task task)
    {
        try {
            task();
            return 0;
        } catch (const std::exception& error) {
            problem = error.what();
            return -1;
        }
    }

    // Returns whether at least half of the finite points are near enough for a LiDAR, as Python's function does.
    static bool shows_something(const float* points, int32_t count, const float* position)
    {
        int32_t finite = 0, near = 0;
        for (int32_t i = 0; i < count; ++i) {
            double square = 0.0;
            for (int axis = 0; axis < 3; ++axis) {
                const double offset = static_cast<double>(points[3 * i + axis]) - position[axis];
                square += offset * offset;
            }
            finite += std::isfinite(square);
            near += square <= farthest_return * farthest_return;
        }
        return finite > 0 && 2 * near >= finite;
    }

    // Returns a sentence about the first input that is invalid, or nullptr.
    static const char* find_mistake(const aero_state& state, const aero_goal& goal, float cloud_age, float ground_height)
    {
        const auto is_in_range = [](const float* values, int n) {
            for (int i = 0; i < n; ++i)
                if (!(std::fabs(values[i]) <= farthest)) // false for NaN, too
                    return false;
            return true;
        };
        const auto is_omitted = [](const float* values, int n) {
            for (int i = 0; i < n; ++i)
                if (!std::isnan(values[i]))
                    return false;
            return true;
        };
        const auto length = [](const float* q) {
            return std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
        };
        if (!is_in_range(state.position, 3) || !is_in_range(state.velocity, 3))
            return "the state's position or velocity is not finite or beyond 1e6";
        if (!is_omitted(state.acceleration, 3) && !is_in_range(state.acceleration, 3))
            return "the state's acceleration is not finite or beyond 1e6; give m/s^2, or NaN if it is unknown";
        if (!is_in_range(state.quaternion, 4) || length(state.quaternion) < 1e-6f)
            return "the state's quaternion is not finite or zero; give a unit quaternion in the order w, x, y, z";
        if (std::isinf(state.time))
            return "the state's time is infinite; give seconds, or NaN if it is unknown";
        if (!is_in_range(goal.position, 3) || (!is_omitted(goal.velocity, 3) && !is_in_range(goal.velocity, 3)))
            return "the goal's position or velocity is not finite or beyond 1e6";
        if (!is_omitted(goal.quaternion, 4) && (!is_in_range(goal.quaternion, 4) || length(goal.quaternion) < 1e-6f))
            return "the goal's quaternion is not finite or zero; give a unit quaternion, or NaN to derive it";
        if (!std::isfinite(cloud_age) || cloud_age < 0.0f)
            return "the age of the cloud is not finite or negative";
        if (!(ground_height <= farthest) || (std::isfinite(ground_height) && ground_height < -farthest))
            return "the ground height is NaN or beyond 1e6; give metres, or -INFINITY if it is unknown";
        return nullptr;
    }
};

aero_planner* aero_open(const char* folder, const char* device, char* problem, size_t room)
{
    auto planner = std::make_unique<aero_planner>();
    if (planner->attempt([&] { planner->open(folder, device); }) == 0)
        return planner.release();
    if (problem && room) {
        std::strncpy(problem, planner->problem.c_str(), room - 1);
        problem[room - 1] = '\0';
    }
    return nullptr;
}

void aero_close(aero_planner* planner) { delete planner; }

aero_sizes aero_get_sizes(const aero_planner* planner) { return planner->sizes; }

int aero_plan(
    aero_planner* planner, const aero_state* state, const aero_goal* goal, const float* points, int32_t count,
    float cloud_age, float ground_height
)
{
    return planner->attempt([&] { planner->plan(*state, *goal, points, count, cloud_age, ground_height); });
}

const char* aero_problem(const aero_planner* planner) { return planner->problem.c_str(); }

aero_status aero_get_status(const aero_planner* planner) { return planner->status; }

int32_t aero_get_best(const aero_planner* planner) { return planner->best; }

const float* aero_command(aero_planner* planner)
{
    const float* command = nullptr;
    planner->attempt([&] { command = planner->get<float>("previous_controls"); });
    return command;
}

const void* aero_array(aero_planner* planner, const char* name, size_t* size)
{
    const void* array = nullptr;
    planner->attempt([&] {
        array = planner->graph->get(name);
        if (!array)
            throw std::runtime_error(std::string("there is no array ") + name);
    });
    if (size)
        *size = array ? planner->graph->bytes(name) : 0;
    return array;
}

int aero_reset(aero_planner* planner, int32_t seed)
{
    return planner->attempt([&] { planner->reset(seed); });
}
