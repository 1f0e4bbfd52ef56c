// A captured plan on one device: its kernel launches, and the arrays that they read and write, by their Python names.
#ifndef AERO_GRAPH_H
#define AERO_GRAPH_H

#include "apic.h"

#include <cstddef>
#include <cstdint>
#include <initializer_list>
#include <memory>
#include <string>

// Errors are thrown as std::runtime_error, with a message of one sentence.
class Graph {
public:
    virtual ~Graph() = default;

    // Size of an array; 0 if there is no array of that name.
    size_t bytes(const char* name) const
    {
        return wp_apic_get_param_ptr(graph_, name) ? wp_apic_get_param_size(graph_, name) : 0;
    }

    // Overwrite the beginning of an array.
    virtual void put(const char* name, const void* values, size_t size) = 0;

    // Run all launches and wait for them. The arrays in `results` are fetched at once, which is faster than one by one.
    virtual void replay(std::initializer_list<const char*> results) = 0;

    // Contents of an array, or nullptr if there is none of that name. The pointer is valid as long as the graph.
    virtual const void* get(const char* name) = 0;

protected:
    APICGraph* graph_ = nullptr;
};

// Versions and processor that a graph was captured for, read from `target.txt` beside it.
struct Target {
    std::string warp;
    int32_t instances = 0;
    std::string processor; // triple and features of a CPU, on two lines
};

// An array that a planner carries from plan to plan, read from `state.txt` beside the graph.
struct State {
    std::string name;
    std::string initial; // the bytes of one of its numbers where nothing is known yet
};

// Load STEM.wrp and STEM_modules.
std::unique_ptr<Graph> open_cpu_graph(const std::string& stem, const Target& target);
std::unique_ptr<Graph> open_cuda_graph(const std::string& stem, int ordinal);

#endif
