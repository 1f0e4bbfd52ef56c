// A captured plan on one device: its launches, and the arrays that they read and write, by their names in Python.
#ifndef AERO_GRAPH_H
#define AERO_GRAPH_H

#include "apic.h"

#include <cstddef>
#include <cstdint>
#include <initializer_list>
#include <memory>
#include <string>

// What goes wrong is thrown as std::runtime_error, in one sentence.
class Graph {
public:
    virtual ~Graph() = default;

    // Size of an array; 0 where there is none of that name.
    size_t bytes(const char* name) const
    {
        return wp_apic_get_param_ptr(graph_, name) ? wp_apic_get_param_size(graph_, name) : 0;
    }

    // Overwrite the beginning of an array.
    virtual void put(const char* name, const void* values, size_t size) = 0;

    // Run all launches and wait for them. The arrays in `wanted` come back along, which is faster than one by one.
    virtual void replay(std::initializer_list<const char*> wanted) = 0;

    // What an array holds, nullptr where there is none of that name; stays where it is until the graph is gone.
    virtual const void* get(const char* name) = 0;

protected:
    APICGraph* graph_ = nullptr;
};

// What a graph was captured for, as `target.txt` beside it says.
struct Target {
    std::string warp;
    int32_t instances = 0;
    std::string processor; // triple and features of a CPU, on two lines
};

// Load STEM.wrp and STEM_modules.
std::unique_ptr<Graph> open_cpu_graph(const std::string& stem, const Target& target);
std::unique_ptr<Graph> open_cuda_graph(const std::string& stem, int ordinal);

#endif
