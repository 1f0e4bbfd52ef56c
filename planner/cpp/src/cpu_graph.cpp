// Graphs on the CPU. Their kernels are object files, which the linker in warp-clang.so loads. That library is opened on
// first use, so that a host that plans on a GPU does not need it.
#include "graph.h"

#include "warp.h"
#include "warp_clang.h"

#include <atomic>
#include <cstring>
#include <dlfcn.h>
#include <fstream>
#include <map>
#include <mutex>
#include <stdexcept>
#include <vector>

namespace {

struct Clang {
    decltype(&wp_warp_clang_version) version;
    decltype(&wp_llvm_set_cpu_block_runtime) set_block_runtime;
    decltype(&wp_load_obj) load;
    decltype(&wp_unload_obj) unload;
    decltype(&wp_lookup) lookup;
    const char* (*triple)();
    const char* (*features)();
};

template <class F> void find(void* library, F& function, const char* name)
{
    function = reinterpret_cast<F>(dlsym(library, name));
    if (!function)
        throw std::runtime_error(std::string("warp-clang.so lacks ") + name + "; install Warp again");
}

Clang load_clang()
{
    Dl_info warp;
    if (!dladdr(reinterpret_cast<void*>(&wp_init), &warp) || !warp.dli_fname)
        throw std::runtime_error("warp.so can't be found");
    const std::string file = warp.dli_fname;
    const std::string path = file.substr(0, file.rfind('/') + 1) + "warp-clang.so";
    void* library = dlopen(path.c_str(), RTLD_NOW);
    if (!library)
        throw std::runtime_error(std::string("planning on the CPU needs warp-clang.so beside warp.so: ") + dlerror());
    Clang clang {};
    find(library, clang.version, "wp_warp_clang_version");
    if (std::strcmp(clang.version(), WP_VERSION_STRING) != 0)
        throw std::runtime_error(path + " belongs to Warp " + clang.version() + "; this program was built for "
                                 WP_VERSION_STRING);
    find(library, clang.set_block_runtime, "wp_llvm_set_cpu_block_runtime");
    find(library, clang.load, "wp_load_obj");
    find(library, clang.unload, "wp_unload_obj");
    find(library, clang.lookup, "wp_lookup");
    find(library, clang.triple, "wp_get_cpu_target_triple");
    find(library, clang.features, "wp_get_host_cpu_features");
    if (!clang.set_block_runtime(wp_cpu_block_runtime_get_api()))
        throw std::runtime_error("warp.so and warp-clang.so are of different builds; install Warp again");
    return clang;
}

const Clang& clang()
{
    static const Clang functions = load_clang(); // if this throws, the next call tries again
    return functions;
}

class CpuGraph : public Graph {
public:
    explicit CpuGraph(const std::string& stem)
    {
        try {
            load(stem);
        } catch (...) {
            unload();
            throw;
        }
    }

    ~CpuGraph() override { unload(); }

    void put(const char* name, const void* values, size_t size) override
    {
        std::memcpy(wp_apic_get_param_ptr(graph_, name), values, size);
    }

    void replay(std::initializer_list<const char*>) override
    {
        if (!wp_apic_cpu_replay_graph(graph_))
            throw std::runtime_error(std::string("the launch of the graph failed: ") + wp_get_error_string());
    }

    const void* get(const char* name) override { return wp_apic_get_param_ptr(graph_, name); }

private:
    void load(const std::string& stem)
    {
        graph_ = wp_apic_load_graph(nullptr, (stem + ".wrp").c_str(), APIC_DEVICE_CPU);
        if (!graph_)
            throw std::runtime_error(stem + ".wrp can't be loaded: " + wp_get_error_string());
        static std::atomic<int> loads {0};
        const std::string prefix = "aero_" + std::to_string(loads++) + "_";
        std::map<std::string, std::string> loaded;
        for (int i = 0; i < wp_apic_get_num_kernels(graph_); ++i) {
            const char* file = wp_apic_get_kernel_module_binary_filename(graph_, i);
            const char* forward = wp_apic_get_kernel_forward_name(graph_, i);
            if (!file || !forward || std::strchr(file, '/'))
                throw std::runtime_error(
                    stem + ".wrp names no object file for one of its kernels; export the bundle again");
            if (!loaded.count(file)) {
                const std::string path = stem + "_modules/" + file;
                // Warp's linker ends the process if the file does not exist.
                if (!std::ifstream(path))
                    throw std::runtime_error(path + " is missing: copy the whole bundle");
                if (clang().load(path.c_str(), (prefix + file).c_str(), false) != 0)
                    throw std::runtime_error(path + " can't be loaded; export the bundle again");
                modules_.push_back(loaded[file] = prefix + file);
            }
            void* function = reinterpret_cast<void*>(clang().lookup(loaded[file].c_str(), forward));
            if (!function)
                throw std::runtime_error(
                    std::string(file) + " lacks the kernel " + forward + "; export the bundle again");
            wp_apic_register_loaded_cpu_kernel(
                graph_, wp_apic_get_kernel_key(graph_, i), wp_apic_get_kernel_module_hash(graph_, i), function, nullptr
            );
        }
    }

    void unload()
    {
        if (graph_)
            wp_apic_destroy_graph(graph_);
        for (const std::string& module : modules_)
            clang().unload(module.c_str());
    }

    std::vector<std::string> modules_;
};

} // namespace

std::unique_ptr<Graph> open_cpu_graph(const std::string& stem, const Target& target)
{
    // Machine code for another processor would be loaded without an error and crash when it runs.
    if (target.processor != std::string(clang().triple()) + "\n" + clang().features())
        throw std::runtime_error("the bundle is for another CPU; export it again with --cpu on this machine");
    return std::make_unique<CpuGraph>(stem);
}
