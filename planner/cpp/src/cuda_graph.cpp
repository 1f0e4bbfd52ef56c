// Graphs on a GPU. Every array that the host reads or writes has a copy in page-locked host memory.
#include "graph.h"

#include "warp.h"

#include <cstring>
#include <functional>
#include <map>
#include <stdexcept>
#include <string_view>

namespace {

class CudaGraph : public Graph {
public:
    CudaGraph(const std::string& stem, int ordinal)
        : context_(wp_cuda_device_get_primary_context(ordinal))
    {
        if (!context_)
            fail("the GPU can't be used");
        stream_ = wp_cuda_stream_create(context_, 0);
        if (!stream_)
            fail("the GPU can't be used");
        graph_ = wp_apic_load_graph(context_, (stem + ".wrp").c_str(), APIC_DEVICE_CUDA);
        // Instantiate the CUDA graph now, so that the first plan does not have to.
        const bool ready = graph_ && wp_apic_get_cuda_graph_exec(graph_) && wp_cuda_context_synchronize(context_);
        if (!ready) {
            const std::string reason = wp_get_error_string();
            release();
            throw std::runtime_error(
                stem + ".wrp can't be loaded: " + reason + "; copy the whole bundle, or export again");
        }
    }

    ~CudaGraph() override { release(); }

    void put(const char* name, const void* values, size_t size) override
    {
        Copy* copy = find(name);
        std::memcpy(copy->host, values, size);
        copy->is_current = false;
        if (!wp_memcpy_h2d(context_, copy->device, copy->host, size, stream_))
            fail("copying to the GPU failed");
    }

    void replay(std::initializer_list<const char*> results) override
    {
        for (auto& [name, copy] : copies_)
            copy.is_current = false;
        if (!wp_apic_launch(graph_, stream_))
            fail("the launch of the graph failed");
        for (const char* name : results)
            fetch(*find(name));
        wait();
        for (const char* name : results)
            find(name)->is_current = true;
    }

    const void* get(const char* name) override
    {
        Copy* copy = find(name);
        if (copy && !copy->is_current) {
            fetch(*copy);
            wait();
            copy->is_current = true;
        }
        return copy ? copy->host : nullptr;
    }

private:
    struct Copy {
        void* device = nullptr;
        void* host = nullptr;
        size_t size = 0;
        bool is_current = false; // the host copy equals the device array
    };

    // Returns the copy of an array, which is made on its first use; nullptr if there is no such array.
    Copy* find(const char* name)
    {
        const auto existing = copies_.find(std::string_view(name)); // does not allocate
        if (existing != copies_.end())
            return &existing->second;
        Copy copy;
        copy.device = wp_apic_get_param_ptr(graph_, name);
        if (!copy.device)
            return nullptr;
        copy.size = wp_apic_get_param_size(graph_, name);
        copy.host = wp_alloc_pinned(copy.size);
        if (!copy.host)
            fail("page-locked memory can't be allocated");
        return &(copies_[name] = copy);
    }

    void fetch(const Copy& copy)
    {
        if (!wp_memcpy_d2h(context_, copy.host, copy.device, copy.size, stream_))
            fail("copying from the GPU failed");
    }

    void wait()
    {
        if (!wp_cuda_stream_synchronize(stream_))
            fail("the GPU reported an error");
    }

    [[noreturn]] static void fail(const char* what)
    {
        throw std::runtime_error(std::string(what) + ": " + wp_get_error_string());
    }

    void release()
    {
        for (auto& [name, copy] : copies_)
            wp_free_pinned(copy.host);
        if (graph_)
            wp_apic_destroy_graph(graph_);
        if (stream_)
            wp_cuda_stream_destroy(context_, stream_);
    }

    void* context_;
    void* stream_ = nullptr;
    std::map<std::string, Copy, std::less<>> copies_;
};

} // namespace

std::unique_ptr<Graph> open_cuda_graph(const std::string& stem, int ordinal)
{
    return std::make_unique<CudaGraph>(stem, ordinal);
}
