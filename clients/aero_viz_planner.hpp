// A planner in a process of its own, for AERO-Viz: one header, C++17 and POSIX sockets only.
//
//     aero_viz::Reply plan(const aero_viz::Request& request);   // request.position, request.points, request.config
//     int main() { aero_viz::serve("/tmp/mine.sock", plan, {{"reach", 6.0, 1.0, 20.0, "m", "How far it looks."}}); }
//
// Then `aero-viz demo --planner connect:/tmp/mine.sock`. docs/planners.md describes the messages.

#pragma once

#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

#include <array>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <map>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

namespace aero_viz {

using Vector = std::array<double, 3>;

struct Parameter {
    std::string name;
    double standard, low, high;
    std::string unit, help;
};

// What AERO-Viz knows at one tick: SI units, world frame (x forward, y left, z up).
struct Request {
    double time = 0.0, cloud_age = 0.0;
    double ground_height = NAN;               // NaN where it is unknown
    Vector position{}, velocity{}, goal{};
    std::array<double, 4> quaternion{1.0};    // w x y z, body to world
    std::vector<float> points;                // x y z of one point after another; may hold NaN
    std::map<std::string, double> config;     // parameters, and the drone's, such as "vehicle.speed_limit"
    double history = 0.0;                     // `Reply::history` of the tick before
};

struct Reply {
    std::vector<std::vector<Vector>> paths;   // M candidates of equal length, the start included
    std::map<std::string, std::vector<double>> costs;
    int best = 0;
    double step = 0.1;                        // [s]
    int status = 0;                           // 0 safe, 1 no candidate is safe
    std::vector<std::array<double, 4>> controls;  // acceleration and yaw rate; empty: along the chosen path
    double history = 0.0;
};

namespace detail {

// Reads the JSON objects that AERO-Viz sends: numbers, texts, null, true, false, and nested lists and objects.
// Numbers are stored by their path, such as "position.0" and "config.reach".
class Reader {
public:
    explicit Reader(const std::string& text) : at_(text.c_str()), end_(at_ + text.size()) { value(""); }
    std::map<std::string, double> numbers;
    std::map<std::string, std::string> texts;

    double number(const std::string& path, double otherwise = 0.0) const {
        auto found = numbers.find(path);
        return found == numbers.end() ? otherwise : found->second;
    }

private:
    void space() { while (at_ < end_ && std::strchr(" \t\r\n", *at_)) ++at_; }

    std::string text() {
        std::string read;
        for (++at_; at_ < end_ && *at_ != '"'; ++at_) {
            if (*at_ == '\\' && at_ + 1 < end_) ++at_;
            read += *at_;
        }
        if (at_++ >= end_) throw std::runtime_error("the message is cut off");
        return read;
    }

    void members(const std::string& path, char closing) {
        for (int i = 0;; ++i) {
            space();
            if (at_ < end_ && (*at_ == closing || *at_ == ',')) {
                if (*at_++ == closing) return;
                --i;
                continue;
            }
            if (at_ >= end_) throw std::runtime_error("the message is cut off");
            std::string name = closing == '}' ? text() : std::to_string(i);
            space();
            if (closing == '}') ++at_;  // the colon
            value(path.empty() ? name : path + "." + name);
        }
    }

    void value(const std::string& path) {
        space();
        if (at_ >= end_) throw std::runtime_error("the message is cut off");
        if (*at_ == '{' || *at_ == '[') {
            char closing = *at_++ == '{' ? '}' : ']';
            members(path, closing);
        } else if (*at_ == '"') {
            texts[path] = text();
        } else if (std::strchr("-0123456789", *at_)) {
            char* after = nullptr;
            numbers[path] = std::strtod(at_, &after);
            at_ = after;
        } else {
            if (*at_ == 't') numbers[path] = 1.0;
            while (at_ < end_ && *at_ >= 'a' && *at_ <= 'z') ++at_;  // null, true, false
        }
    }

    const char *at_, *end_;
};

inline std::string quoted(const std::string& text) {
    std::string result = "\"";
    for (char letter : text) {
        if (letter == '"' || letter == '\\') result += '\\';
        result += static_cast<unsigned char>(letter) < ' ' ? ' ' : letter;
    }
    return result + "\"";
}

inline std::string written(double value) {
    char text[32];
    std::snprintf(text, sizeof text, "%.9g", std::isfinite(value) ? value : 1e30);
    return text;
}

template <class Values>
std::string list(const Values& values) {
    std::string result = "[";
    for (double value : values) result += (result.size() > 1 ? "," : "") + written(value);
    return result + "]";
}

inline bool read(int connection, void* data, std::size_t size) {
    for (std::size_t done = 0; done < size;) {
        ssize_t part = ::recv(connection, static_cast<char*>(data) + done, size - done, 0);
        if (part <= 0) return false;
        done += static_cast<std::size_t>(part);
    }
    return true;
}

inline void send(int connection, const std::string& text, const std::vector<float>& numbers = {}) {
    std::uint32_t sizes[2] = {static_cast<std::uint32_t>(text.size()), static_cast<std::uint32_t>(4 * numbers.size())};
    std::string data(reinterpret_cast<const char*>(sizes), sizeof sizes);
    data += text;
    data.append(reinterpret_cast<const char*>(numbers.data()), sizes[1]);
    for (std::size_t done = 0; done < data.size();) {
        ssize_t part = ::send(connection, data.data() + done, data.size() - done, MSG_NOSIGNAL);
        if (part <= 0) return;
        done += static_cast<std::size_t>(part);
    }
}

inline Request request_of(const Reader& message, std::vector<float> points) {
    Request request;
    request.points = std::move(points);
    request.time = message.number("time");
    request.cloud_age = message.number("cloud_age");
    request.ground_height = message.number("ground_height", NAN);
    request.history = message.number("history");
    for (std::size_t i = 0; i < 4; ++i) request.quaternion[i] = message.number("quaternion." + std::to_string(i));
    for (std::size_t i = 0; i < 3; ++i) {
        request.position[i] = message.number("position." + std::to_string(i));
        request.velocity[i] = message.number("velocity." + std::to_string(i));
        request.goal[i] = message.number("goal." + std::to_string(i));
    }
    for (const auto& [path, value] : message.numbers)
        if (path.rfind("config.", 0) == 0) request.config[path.substr(7)] = value;
    return request;
}

inline void answer(int connection, const std::function<Reply(const Request&)>& plan, const std::string& hello) {
    std::uint32_t sizes[2];
    while (read(connection, sizes, sizeof sizes)) {
        std::string text(sizes[0], ' ');
        std::vector<float> points(sizes[1] / 4);
        if (!read(connection, text.data(), sizes[0]) || !read(connection, points.data(), 4 * points.size())) break;
        try {
            Reader message(text);
            if (message.texts["type"] == "hello") {
                send(connection, hello);
                continue;
            }
            Reply reply = plan(request_of(message, std::move(points)));
            std::vector<float> places;
            for (const auto& path : reply.paths)
                for (const auto& place : path) places.insert(places.end(), place.begin(), place.end());
            std::size_t length = reply.paths.empty() ? 0 : reply.paths[0].size();
            std::string costs, controls;
            for (const auto& [name, values] : reply.costs)
                costs += (costs.empty() ? "" : ",") + quoted(name) + ":" + list(values);
            for (const auto& control : reply.controls) controls += (controls.empty() ? "" : ",") + list(control);
            send(connection, "{\"type\":\"plan\",\"shape\":[" + std::to_string(reply.paths.size()) + "," +
                 std::to_string(length) + ",3],\"costs\":{" + costs + "},\"best\":" + std::to_string(reply.best) +
                 ",\"step\":" + written(reply.step) + ",\"status\":" + std::to_string(reply.status) +
                 (controls.empty() ? "" : ",\"controls\":[" + controls + "]") + ",\"history\":" +
                 written(reply.history) + "}", places);
        } catch (const std::exception& error) {  // it ends the flight; the next one may go well
            send(connection, "{\"type\":\"error\",\"text\":" + quoted(error.what()) + "}");
        }
    }
    ::close(connection);
}

}  // namespace detail

// Answer requests for ever at the path of a Unix socket, which is replaced; each connection on a thread of its own.
inline void serve(const std::string& address, std::function<Reply(const Request&)> plan,
                  const std::vector<Parameter>& parameters = {}, const std::string& name = "planner") {
    std::string list;
    for (const Parameter& one : parameters)
        list += (list.empty() ? "{" : ",{") + std::string("\"name\":") + detail::quoted(one.name) + ",\"default\":" +
                detail::written(one.standard) + ",\"low\":" + detail::written(one.low) + ",\"high\":" +
                detail::written(one.high) + ",\"unit\":" + detail::quoted(one.unit) + ",\"help\":" +
                detail::quoted(one.help) + "}";
    std::string hello = "{\"type\":\"hello\",\"version\":1,\"name\":" + detail::quoted(name) + ",\"parameters\":[" +
                        list + "]}";
    sockaddr_un place{};
    place.sun_family = AF_UNIX;
    if (address.size() >= sizeof place.sun_path) throw std::runtime_error("the path of the socket is too long");
    std::strcpy(place.sun_path, address.c_str());
    ::unlink(address.c_str());
    int listener = ::socket(AF_UNIX, SOCK_STREAM, 0);
    if (listener < 0 || ::bind(listener, reinterpret_cast<sockaddr*>(&place), sizeof place) || ::listen(listener, 8))
        throw std::runtime_error("cannot listen at " + address);
    std::fprintf(stderr, "planner %s listens at %s\n", name.c_str(), address.c_str());
    for (int connection; (connection = ::accept(listener, nullptr, nullptr)) >= 0;)
        std::thread([=] { detail::answer(connection, plan, hello); }).detach();
}

}  // namespace aero_viz
