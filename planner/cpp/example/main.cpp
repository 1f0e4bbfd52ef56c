// Example of a host: plans for each request in a file and writes the answers to another one.
//
//     aero_example BUNDLE DEVICE REQUESTS ANSWERS
//
// DEVICE is cpu or cuda:0. REQUESTS holds binary records:
//     double time; float position[3], velocity[3], quaternion[4], acceleration[3], goal[3], cloud_age, ground_height;
//     int32 count; float points[count][3].
// ANSWERS holds for each request:
//     int32 status, best; float command[N][4], controls[R][N][4], positions[R][N+1][3], stage2_cost[R].
#include "aero_planner.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <fstream>
#include <memory>
#include <vector>

namespace {

template <class T> bool read(std::ifstream& file, T* values, size_t count = 1)
{
    return static_cast<bool>(file.read(reinterpret_cast<char*>(values), sizeof(T) * count));
}

template <class T> void write(std::ofstream& file, const T* values, size_t count = 1)
{
    file.write(reinterpret_cast<const char*>(values), static_cast<std::streamsize>(sizeof(T) * count));
}

void write_array(std::ofstream& file, aero_planner* planner, const char* name)
{
    size_t size = 0;
    const void* array = aero_array(planner, name, &size);
    write(file, static_cast<const char*>(array), size);
}

} // namespace

int main(int count, char** arguments)
{
    if (count != 5) {
        std::fprintf(stderr, "usage: %s BUNDLE DEVICE REQUESTS ANSWERS\n", arguments[0]);
        return 2;
    }
    char problem[1024] = "";
    const auto begin = std::chrono::steady_clock::now();
    const std::unique_ptr<aero_planner, void (*)(aero_planner*)> planner(
        aero_open(arguments[1], arguments[2], problem, sizeof problem), aero_close
    );
    if (!planner) {
        std::fprintf(stderr, "%s\n", problem);
        return 2;
    }
    const std::chrono::duration<double, std::milli> loading = std::chrono::steady_clock::now() - begin;
    const aero_sizes sizes = aero_get_sizes(planner.get());
    std::printf("%d instances, %d steps, up to %d points, loaded in %.0f ms\n", sizes.instances, sizes.steps,
                sizes.points, loading.count());
    aero_reset(planner.get(), 0);

    std::ifstream requests(arguments[3], std::ios::binary);
    std::ofstream answers(arguments[4], std::ios::binary);
    std::vector<float> points(3 * static_cast<size_t>(sizes.points));
    std::vector<double> times;
    aero_state state;
    while (read(requests, &state.time)) {
        aero_goal goal;
        float cloud_age = 0.0f, ground_height = -INFINITY;
        int32_t number = 0;
        const bool is_complete = read(requests, state.position, 3) && read(requests, state.velocity, 3)
            && read(requests, state.quaternion, 4) && read(requests, state.acceleration, 3)
            && read(requests, goal.position, 3) && read(requests, &cloud_age) && read(requests, &ground_height)
            && read(requests, &number);
        const bool fits = number >= 0 && number <= sizes.points; // otherwise aero_plan reports it
        if (!is_complete || (fits && !read(requests, points.data(), 3 * static_cast<size_t>(number)))) {
            std::fprintf(stderr, "%s ends within a record\n", arguments[3]);
            return 2;
        }
        std::fill_n(goal.velocity, 3, NAN);   // arrive and stop
        std::fill_n(goal.quaternion, 4, NAN); // level, with the nose toward the goal

        const auto start = std::chrono::steady_clock::now();
        if (aero_plan(planner.get(), &state, &goal, points.data(), number, cloud_age, ground_height) != 0) {
            std::fprintf(stderr, "%s\n", aero_problem(planner.get()));
            return 2;
        }
        times.push_back(std::chrono::duration<double, std::milli>(std::chrono::steady_clock::now() - start).count());

        const int32_t status = aero_get_status(planner.get()), best = aero_get_best(planner.get());
        write(answers, &status);
        write(answers, &best);
        write(answers, aero_command(planner.get()), 4 * static_cast<size_t>(sizes.steps));
        for (const char* name : {"controls", "positions", "stage2_cost"})
            write_array(answers, planner.get(), name);
    }
    if (times.empty() || !answers.flush()) {
        std::fprintf(stderr, "%s holds no request, or %s can't be written\n", arguments[3], arguments[4]);
        return 2;
    }
    std::nth_element(times.begin(), times.begin() + times.size() / 2, times.end());
    std::printf("%zu plans, %.2f ms each (median)\n", times.size(), times[times.size() / 2]);
    return 0;
}
