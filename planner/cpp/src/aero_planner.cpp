// The C interface of aero_planner.h on Warp's API capture (APIC): a list of launches over memory regions with names.
#include "aero_planner.h"

#include "apic.h"
#include "warp.h"
#include "warp_clang.h"

#include <atomic>
#include <cmath>
#include <cstring>
#include <fstream>
#include <limits>
#include <map>
#include <mutex>
#include <stdexcept>
#include <string>
#include <vector>

extern "C" {
// Exported by warp-clang without a declaration in its header.
WP_API const char* wp_get_cpu_target_triple();
WP_API const char* wp_get_host_cpu_features();
}

namespace {

constexpr float farthest = 1e6f; // where float32 still tells decimetres apart, as in Python

void start_warp()
{
    static std::mutex mutex;
    static bool started = false;
    const std::lock_guard<std::mutex> lock(mutex);
    if (started)
        return;
    if (std::strcmp(wp_warp_clang_version(), WP_VERSION_STRING) != 0)
        throw std::runtime_error(
            std::string("this program was built for Warp " WP_VERSION_STRING ", and finds Warp ")
            + wp_warp_clang_version() + "; build it again");
    if (wp_init(WP_VERSION_STRING) != 0)
        throw std::runtime_error(std::string("Warp can't be started: ") + wp_get_error_string());
    if (!wp_llvm_set_cpu_block_runtime(wp_cpu_block_runtime_get_api()))
        throw std::runtime_error("warp.so and warp-clang.so do not fit together; install Warp again");
    started = true;
}

// Returns the number of instances. Machine code for another processor would not fail before it runs.
int32_t check_target(const std::string& path)
{
    std::ifstream file(path);
    std::string warp, triple, features;
    int32_t instances = 0;
    if (!std::getline(file, warp) || !std::getline(file, triple) || !std::getline(file, features)
        || !(file >> instances))
        throw std::runtime_error(
            path + " can't be read: give the folder of a bundle made by 'aero-planner export --cpu'");
    if (warp != WP_VERSION_STRING)
        throw std::runtime_error(
            "the bundle is for Warp " + warp + ", this program for " WP_VERSION_STRING
            ": export it again with that version");
    if (triple != wp_get_cpu_target_triple() || features != wp_get_host_cpu_features())
        throw std::runtime_error("the bundle is for another CPU: export it again with --cpu on this machine");
    return instances;
}

} // namespace

struct aero_planner {
    APICGraph* graph = nullptr;
    std::vector<std::string> modules;
    aero_sizes sizes {};
    mutable std::string problem;

    ~aero_planner()
    {
        if (graph)
            wp_apic_destroy_graph(graph);
        for (const std::string& module : modules)
            wp_unload_obj(module.c_str());
    }

    size_t bytes(const char* name) const
    {
        return wp_apic_get_param_ptr(graph, name) ? wp_apic_get_param_size(graph, name) : 0;
    }

    template <class T> T* at(const char* name) const { return static_cast<T*>(wp_apic_get_param_ptr(graph, name)); }

    void load(const std::string& stem)
    {
        graph = wp_apic_load_graph(nullptr, (stem + ".wrp").c_str(), APIC_DEVICE_CPU);
        if (!graph)
            throw std::runtime_error(stem + ".wrp can't be loaded: " + wp_get_error_string());
        static std::atomic<int> loads {0};
        const std::string prefix = "aero_" + std::to_string(loads++) + "_";
        std::map<std::string, std::string> loaded;
        for (int i = 0; i < wp_apic_get_num_kernels(graph); ++i) {
            const char* file = wp_apic_get_kernel_module_binary_filename(graph, i);
            const char* forward = wp_apic_get_kernel_forward_name(graph, i);
            if (!file || !forward || std::strchr(file, '/'))
                throw std::runtime_error(stem + ".wrp names no object for one of its kernels");
            if (!loaded.count(file)) {
                const std::string path = stem + "_modules/" + file;
                // Warp's linker ends the process at a file that isn't there.
                if (!std::ifstream(path))
                    throw std::runtime_error(path + " is missing: copy the whole bundle");
                if (wp_load_obj(path.c_str(), (prefix + file).c_str(), false) != 0)
                    throw std::runtime_error(path + " can't be loaded");
                modules.push_back(loaded[file] = prefix + file);
            }
            void* function = reinterpret_cast<void*>(wp_lookup(loaded[file].c_str(), forward));
            if (!function)
                throw std::runtime_error(std::string(file) + " lacks the kernel " + forward);
            wp_apic_register_loaded_cpu_kernel(
                graph, wp_apic_get_kernel_key(graph, i), wp_apic_get_kernel_module_hash(graph, i), function, nullptr
            );
        }
    }

    void measure(int32_t instances)
    {
        const struct {
            const char* name;
            size_t bytes;
        } fixed[] = {
            {"time", 8}, {"position", 12}, {"velocity", 12}, {"quaternion", 16}, {"acceleration", 12},
            {"goal_position", 12}, {"goal_velocity", 12}, {"goal_quaternion", 16}, {"cloud_age", 4},
            {"point_count", 4}, {"best", 4}, {"status", 4}, {"seed", 4}, {"tick", 4}, {"previous_time", 8},
        };
        bool fits = true;
        for (const auto& one : fixed)
            fits &= bytes(one.name) == one.bytes;
        const size_t row = bytes("previous_controls"), count = bytes("S2") / sizeof(float);
        fits &= row > 0 && row % 16 == 0 && bytes("controls") == count * row && bytes("points") >= 12;
        fits &= instances > 0 && static_cast<size_t>(instances) <= count;
        fits &= bytes("positions") == count * (row / 16 + 1) * 12;
        if (!fits)
            throw std::runtime_error("the graph is none of a planner for one drone: export it again");
        sizes.instances = instances;
        sizes.rows = static_cast<int32_t>(count);
        sizes.steps = static_cast<int32_t>(row / 16);
        sizes.points = static_cast<int32_t>(bytes("points") / 12);
    }

    // Returns what is wrong with the inputs, or nullptr.
    static const char* check(const aero_state& state, const aero_goal& goal, float cloud_age)
    {
        const auto within = [](const float* values, int n) {
            for (int i = 0; i < n; ++i)
                if (!(std::fabs(values[i]) <= farthest)) // false for NaN, too
                    return false;
            return true;
        };
        const auto left_out = [](const float* values, int n) {
            for (int i = 0; i < n; ++i)
                if (!std::isnan(values[i]))
                    return false;
            return true;
        };
        const auto length = [](const float* q) {
            return std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
        };
        if (!within(state.position, 3) || !within(state.velocity, 3) || !within(state.acceleration, 3))
            return "the state's position, velocity or acceleration is not finite or beyond 1e6";
        if (!within(state.quaternion, 4) || length(state.quaternion) < 1e-6f)
            return "the state's quaternion is not finite or zero; give a unit quaternion in the order w, x, y, z";
        if (std::isinf(state.time))
            return "the state's time is infinite; give seconds, or NaN where it is unknown";
        if (!within(goal.position, 3) || (!left_out(goal.velocity, 3) && !within(goal.velocity, 3)))
            return "the goal's position or velocity is not finite or beyond 1e6";
        if (!left_out(goal.quaternion, 4) && (!within(goal.quaternion, 4) || length(goal.quaternion) < 1e-6f))
            return "the goal's quaternion is not finite or zero; give a unit quaternion, or NaN to derive it";
        if (!std::isfinite(cloud_age))
            return "the cloud's age is not finite";
        return nullptr;
    }
};

aero_planner* aero_open(const char* folder, char* problem, size_t room)
{
    auto* planner = new aero_planner;
    try {
        start_warp();
        const std::string graph = std::string(folder) + "/graph/";
        const int32_t instances = check_target(graph + "target.txt");
        planner->load(graph + "planner");
        planner->measure(instances);
        return planner;
    } catch (const std::exception& error) {
        if (problem && room) {
            std::strncpy(problem, error.what(), room - 1);
            problem[room - 1] = '\0';
        }
        delete planner;
        return nullptr;
    }
}

void aero_close(aero_planner* planner) { delete planner; }

aero_sizes aero_get_sizes(const aero_planner* planner) { return planner->sizes; }

int aero_plan(
    aero_planner* planner, const aero_state* state, const aero_goal* goal, const float* points, int32_t count,
    float cloud_age
)
{
    const char* wrong = aero_planner::check(*state, *goal, cloud_age);
    if (!wrong && (count < 0 || count > planner->sizes.points))
        wrong = "the number of points is negative or more than the graph has room for; thin them out, or raise "
                "lidar.points_max and export again";
    if (wrong) {
        planner->problem = wrong;
        return -1;
    }
    std::memcpy(planner->at<float>("position"), state->position, sizeof state->position);
    std::memcpy(planner->at<float>("velocity"), state->velocity, sizeof state->velocity);
    std::memcpy(planner->at<float>("quaternion"), state->quaternion, sizeof state->quaternion);
    std::memcpy(planner->at<float>("acceleration"), state->acceleration, sizeof state->acceleration);
    std::memcpy(planner->at<float>("goal_position"), goal->position, sizeof goal->position);
    std::memcpy(planner->at<float>("goal_velocity"), goal->velocity, sizeof goal->velocity);
    std::memcpy(planner->at<float>("goal_quaternion"), goal->quaternion, sizeof goal->quaternion);
    *planner->at<double>("time") = state->time;
    *planner->at<float>("cloud_age") = cloud_age;
    *planner->at<int32_t>("point_count") = count;
    if (count)
        std::memcpy(planner->at<float>("points"), points, sizeof(float) * 3 * static_cast<size_t>(count));
    if (!wp_apic_cpu_replay_graph(planner->graph)) {
        planner->problem = std::string("the replay failed: ") + wp_get_error_string();
        return -1;
    }
    return 0;
}

const char* aero_problem(const aero_planner* planner) { return planner->problem.c_str(); }

aero_status aero_get_status(const aero_planner* planner)
{
    return static_cast<aero_status>(*planner->at<int32_t>("status"));
}

int32_t aero_get_best(const aero_planner* planner) { return *planner->at<int32_t>("best"); }

const float* aero_command(const aero_planner* planner) { return planner->at<float>("previous_controls"); }

const void* aero_array(const aero_planner* planner, const char* name, size_t* size)
{
    const void* array = wp_apic_get_param_ptr(planner->graph, name);
    if (size)
        *size = array ? wp_apic_get_param_size(planner->graph, name) : 0;
    return array;
}

void aero_reset(aero_planner* planner, int32_t seed)
{
    *planner->at<int32_t>("seed") = seed;
    *planner->at<int32_t>("tick") = 0;
    std::memset(planner->at<float>("previous_controls"), 0, planner->bytes("previous_controls"));
    *planner->at<double>("previous_time") = std::numeric_limits<double>::quiet_NaN();
}
