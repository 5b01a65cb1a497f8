/* Physics federate `gazebo`: it couples a running Gazebo to fieldkit's coordinator.
 *
 * Standard input and output carry the wire protocol (docs/federates.md); Gazebo Transport connects Gazebo, whose world
 * is advanced in lock-step (docs/gazebo.md). It compiles with Ignition Transport 11 and with Gazebo Transport 12 and
 * later. */

#if !defined(FIELDKIT_GZ) && !__has_include(<ignition/transport/Node.hh>)
#define FIELDKIT_GZ
#endif
#ifdef FIELDKIT_GZ
#include <gz/msgs/boolean.pb.h>
#include <gz/msgs/clock.pb.h>
#include <gz/msgs/empty.pb.h>
#include <gz/msgs/pose.pb.h>
#include <gz/msgs/pose_v.pb.h>
#include <gz/msgs/twist.pb.h>
#include <gz/msgs/world_control.pb.h>
#include <gz/transport/Node.hh>
#include <gz/transport/config.hh>
#define SOFTWARE "Gazebo Transport " GZ_TRANSPORT_VERSION_FULL
namespace msgs = gz::msgs;
namespace transport = gz::transport;
#else
#include <ignition/msgs/boolean.pb.h>
#include <ignition/msgs/clock.pb.h>
#include <ignition/msgs/empty.pb.h>
#include <ignition/msgs/pose.pb.h>
#include <ignition/msgs/pose_v.pb.h>
#include <ignition/msgs/twist.pb.h>
#include <ignition/msgs/world_control.pb.h>
#include <ignition/transport/Node.hh>
#include <ignition/transport/config.hh>
#define SOFTWARE "Ignition Transport " IGNITION_TRANSPORT_VERSION_FULL
namespace msgs = ignition::msgs;
namespace transport = ignition::transport;
#endif

#include <nlohmann/json.hpp>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <chrono>
#include <cmath>
#include <condition_variable>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <limits>
#include <map>
#include <memory>
#include <mutex>
#include <set>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

using Clock = std::chrono::steady_clock;
using Json = nlohmann::json;

enum Kind { HELLO = 2, WELCOME, ADVANCE_PHYSICS, STATES, PING = 8, PONG, BUSY, RELEASE = 13, ERROR, BYE };
constexpr int VERSION = 1, PHYSICS = 1, TWIST = 1, VELOCITY = 2, DETERMINISTIC = 1;
constexpr uint32_t MAX_FRAME_BYTES = 16u << 20;
constexpr size_t MAX_TEXT_BYTES = 1000;

/* The reason for which the federate ends the session; the coordinator shows it. */
struct Failure : std::runtime_error {
    using std::runtime_error::runtime_error;
};

/* ---- Bytes in and out, little endian on every machine ---- */

class Reader {
public:
    Reader(const uint8_t *data, size_t size) : data_(data), size_(size) {}

    const uint8_t *bytes(size_t count)
    {
        if (count > size_ - at_)
            throw Failure("the request is malformed: it ends too early");
        at_ += count;
        return data_ + at_ - count;
    }

    uint64_t number(int count)
    {
        const uint8_t *data = bytes(static_cast<size_t>(count));
        uint64_t value = 0;
        for (int i = count - 1; i >= 0; i--)
            value = value << 8 | data[i];
        return value;
    }

    int64_t time() { return static_cast<int64_t>(number(8)); }

    double real()
    {
        uint64_t bits = number(8);
        double value;
        std::memcpy(&value, &bits, sizeof value);
        return value;
    }

    std::string text()
    {
        size_t size = number(2);
        return std::string(reinterpret_cast<const char *>(bytes(size)), size);
    }

    /* A count of items that have at least this size. */
    uint32_t count(size_t item_bytes)
    {
        uint64_t value = number(4);
        if (value * item_bytes > size_ - at_)
            throw Failure("the request is malformed: a count is larger than the frame");
        return static_cast<uint32_t>(value);
    }

    void end() const
    {
        if (at_ != size_)
            throw Failure("the request is malformed: bytes follow it");
    }

private:
    const uint8_t *data_;
    size_t size_, at_ = 0;
};

class Writer {
public:
    std::string data;

    void number(uint64_t value, int count)
    {
        for (int i = 0; i < count; i++)
            data.push_back(static_cast<char>(value >> (8 * i) & 0xff));
    }

    void real(double value)
    {
        uint64_t bits;
        std::memcpy(&bits, &value, sizeof bits);
        number(bits, 8);
    }

    void text(std::string value)
    {
        value.resize(std::min(value.size(), MAX_TEXT_BYTES));
        number(value.size(), 2);
        data += value;
    }
};

/* ---- Options, and the agents of the run ---- */

struct Vector {
    double x = 0, y = 0, z = 0;
};

struct Options {
    std::string world, partition, ip, acknowledge = "auto", velocity = "step";
    std::string control_service = "/world/{world}/control", pose_service = "/world/{world}/set_pose";
    std::string pose_topic = "/world/{world}/dynamic_pose/info", clock_topic = "/world/{world}/clock";
    std::string command_topic = "/model/{model}/cmd_vel", fence_topic = "/world/{world}/fieldkit/fence";
    std::string fence_answer = "/world/{world}/fieldkit/passed";
    std::map<std::string, std::string> models, command_topics;
    std::map<std::string, std::vector<double>> origins_m;
    double timeout_s = 10, settle_s = 0.5, start_error_m = 0.3, gravity_m_s2 = 9.80665, yaw_gain_per_s = 4;
    double control_period_s = 0.02, limit_m_s2 = std::numeric_limits<double>::infinity();
    bool reset = true, place = true, deterministic = false;

    explicit Options(const Json &json)
    {
        std::set<std::string> known;
        auto read = [&](const char *key, auto &value) {
            known.insert(key);
            if (json.contains(key))
                value = json.at(key).get<std::decay_t<decltype(value)>>();
        };
        read("world", world), read("partition", partition), read("ip", ip);
        read("acknowledge", acknowledge), read("velocity", velocity);
        read("control_service", control_service), read("pose_service", pose_service);
        read("pose_topic", pose_topic), read("clock_topic", clock_topic), read("command_topic", command_topic);
        read("fence_topic", fence_topic), read("fence_answer", fence_answer);
        read("models", models), read("command_topics", command_topics), read("origins_m", origins_m);
        read("timeout_s", timeout_s), read("settle_s", settle_s), read("start_error_m", start_error_m);
        read("gravity_m_s2", gravity_m_s2), read("yaw_gain_per_s", yaw_gain_per_s);
        read("control_period_s", control_period_s), read("limit_m_s2", limit_m_s2);
        read("reset", reset), read("place", place), read("deterministic", deterministic);
        for (const auto &item : json.items())
            if (!known.count(item.key())) {
                std::string names;
                for (const std::string &name : known)
                    names += (names.empty() ? "" : ", ") + name;
                throw Failure("physics.options has no key '" + item.key() + "'; keys: " + names);
            }
        if (acknowledge != "auto" && acknowledge != "required" && acknowledge != "off")
            throw Failure("physics.options.acknowledge is '" + acknowledge + "', not auto, required or off");
        if (velocity != "step" && velocity != "window")
            throw Failure("physics.options.velocity is '" + velocity + "', not step or window");
        if (!(timeout_s > 0 && settle_s >= 0 && control_period_s > 0))
            throw Failure("physics.options: timeout_s and control_period_s must be above 0, settle_s at least 0");
    }

    std::string name(std::string pattern, const std::string &model = "") const
    {
        for (const auto &[key, value] : {std::pair<std::string, std::string>{"{world}", world}, {"{model}", model}})
            for (size_t at; (at = pattern.find(key)) != std::string::npos;)
                pattern.replace(at, key.size(), value);
        return pattern;
    }
};

struct Pose {
    Vector position;
    double w = 1, x = 0, y = 0, z = 0;

    Vector rotated(const Vector &v) const
    {
        double a = 2 * (y * v.z - z * v.y), b = 2 * (z * v.x - x * v.z), c = 2 * (x * v.y - y * v.x);
        return {v.x + w * a + y * c - z * b, v.y + w * b + z * a - x * c, v.z + w * c + x * b - y * a};
    }

    /* The vector in the axes of the model. */
    Vector inverse_rotated(const Vector &v) const { return Pose{{}, w, -x, -y, -z}.rotated(v); }
    double yaw() const { return std::atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)); }
};

struct Agent {
    std::string name, model;
    bool flies = false;
    Vector antenna;      /* in the axes of the model, from its origin */
    Vector start;        /* of the model */
    double start_yaw = 0;
    int command = 0;     /* the type of the command that applies */
    double values[4] = {0, 0, 0, NAN};
    Pose pose, pose_before;
    Vector velocity;
    transport::Node::Publisher publisher;
};

static std::string seconds(int64_t time_ns)
{
    char text[40];
    std::snprintf(text, sizeof text, "%.9f", static_cast<double>(time_ns) / 1e9);
    std::string whole(text);
    whole.erase(whole.find_last_not_of('0') + 1);
    if (whole.back() == '.')
        whole.pop_back();
    return whole + " s";
}

/* ---- A running Gazebo ---- */

class Gazebo {
public:
    /* Called at least once per heartbeat while this waits, with the time that the run has reached. */
    std::function<void(int64_t)> report_busy;

    Gazebo(Options options, std::vector<Agent> agents, int heartbeat_ms)
        : options_(std::move(options)), agents_(std::move(agents)), heartbeat_(heartbeat_ms)
    {
        for (size_t i = 0; i < agents_.size(); i++)
            by_model_[agents_[i].model] = i;
        poses_.resize(agents_.size());
    }

    std::vector<Agent> &agents() { return agents_; }
    int64_t step_ns() const { return step_ns_; }
    int64_t reached_ns() const { return now_ns_ - start_ns_; }

    /* Connect, stop the robots, reset the world, place the robots, and let them come to rest: that is time 0. */
    void begin()
    {
        wait_for_other_runs();
        connect();
        pause();
        measure_step();
        int64_t settle_steps = std::max<int64_t>(std::llround(options_.settle_s * 1e9 / double(step_ns_)), 1);
        send_commands();
        come_to_rest(settle_steps);
        if (options_.reset)
            reset();
        if (options_.place)
            place();
        send_commands();
        step(settle_steps);
        start_ns_ = now_ns_;
        check_start();
        window_poses_ = poses_of_agents();
    }

    /* Advance to a number of steps after the start. */
    void advance(int64_t to_step)
    {
        int64_t at = reached_ns() / step_ns_;
        if (to_step <= at)
            return;
        int64_t period = std::max<int64_t>(std::llround(options_.control_period_s * 1e9 / double(step_ns_)), 1);
        std::vector<Pose> before = poses_of_agents();
        int64_t before_at = at;
        while (at < to_step) {
            int64_t next = to_step;
            bool turned = any_turns();
            if (turned)
                next = std::min(next, (at / period + 1) * period);
            if (options_.velocity == "step" && next == to_step && next - at > 1)
                next--;
            before = poses_of_agents(), before_at = at;
            step(next - at);
            at = next;
            if (turned && at % period == 0)
                send_commands(); /* also when it has reached its direction, to stop it */
        }
        if (options_.velocity == "window")
            before = window_poses_, before_at = window_at_;
        double spent_s = double((at - before_at) * step_ns_) / 1e9;
        for (size_t i = 0; i < agents_.size(); i++) {
            const Vector &p = antenna_of(agents_[i], agents_[i].pose), q = antenna_of(agents_[i], before[i]);
            agents_[i].velocity = {(p.x - q.x) / spent_s, (p.y - q.y) / spent_s, (p.z - q.z) / spent_s};
        }
        window_poses_ = poses_of_agents(), window_at_ = at;
    }

    static Vector antenna_of(const Agent &agent, const Pose &pose)
    {
        Vector offset = pose.rotated(agent.antenna);
        return {pose.position.x + offset.x, pose.position.y + offset.y, pose.position.z + offset.z};
    }

    /* Publish the command of each agent, and wait until Gazebo has received them all. */
    void send_commands()
    {
        for (Agent &agent : agents_)
            if (!agent.publisher.Publish(twist_of(agent)))
                fail("a command to " + agent.name + " cannot be published on " + command_topic(agent));
        acknowledge();
    }

    /* Stop all robots, without waiting; the world stays paused. */
    void stop()
    {
        for (Agent &agent : agents_) {
            std::fill(agent.values, agent.values + 3, 0.0);
            agent.values[3] = NAN;
            agent.publisher.Publish(twist_of(agent));
        }
    }

private:
    std::string command_topic(const Agent &agent) const
    {
        auto special = options_.command_topics.find(agent.name);
        return options_.name(special == options_.command_topics.end() ? options_.command_topic : special->second,
                             agent.model);
    }

    /* Fail with the world's name and its last time; the coordinator adds the request. */
    [[noreturn]] void fail(const std::string &what) const
    {
        std::string last = start_ns_ ? ", whose last time is " + seconds(reached_ns()) : ", which has not started";
        throw Failure("Gazebo world '" + options_.world + "'" + last + ": " + what);
    }

    /* Wait until a condition holds, with the lock. Progress of the clock extends the deadline. */
    template <typename Condition>
    void wait(std::unique_lock<std::mutex> &lock, Condition holds, const std::function<std::string()> &what)
    {
        auto span = std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(options_.timeout_s));
        auto limit = Clock::now() + span, check = Clock::now() + std::chrono::milliseconds(500);
        int64_t progress_ns = clock_ns_;
        while (!holds()) {
            auto now = Clock::now();
            if (clock_ns_ != progress_ns)
                progress_ns = clock_ns_, limit = now + span;
            if (now >= limit)
                fail(what() + " within " + seconds(int64_t(options_.timeout_s * 1e9)) + last_message());
            if (now >= next_heartbeat_) {
                lock.unlock();
                beat();
                lock.lock();
                continue;
            }
            if (now >= check) {
                check = now + std::chrono::milliseconds(500);
                if (is_connected_ && !unlocked(lock, [&] { return has_service(control_service()); }))
                    fail("it has disappeared, or is suspended" + last_message());
                continue;
            }
            changed_.wait_until(lock, std::min({limit, next_heartbeat_, check, now + std::chrono::milliseconds(100)}));
        }
    }

    /* Runs of this machine use a world one after the other: a shootout starts several at a time. Only one process can
     * have a name of an abstract socket, and the name is free when that process ends. */
    void wait_for_other_runs()
    {
        const char *partition = std::getenv("IGN_PARTITION");
        size_t key = std::hash<std::string>()(options_.world + "\n" + (partition ? partition : ""));
        std::string name = "fieldkit-gazebo-" + std::to_string(getuid()) + "-" + std::to_string(key);
        sockaddr_un address = {};
        address.sun_family = AF_UNIX;
        name.copy(address.sun_path + 1, sizeof address.sun_path - 1); /* abstract: the first byte is 0 */
        int lock = socket(AF_UNIX, SOCK_DGRAM | SOCK_CLOEXEC, 0);
        auto limit = Clock::now() + std::chrono::duration<double>(50 * options_.timeout_s);
        while (lock < 0 || bind(lock, reinterpret_cast<sockaddr *>(&address), sizeof address) != 0) {
            if (lock < 0 || errno != EADDRINUSE)
                fail(std::string("a socket cannot be bound: ") + std::strerror(errno));
            if (Clock::now() >= limit)
                fail("another run of this machine uses it");
            if (Clock::now() >= next_heartbeat_)
                beat();
            std::this_thread::sleep_for(std::chrono::milliseconds(20));
        }
    }

    void beat()
    {
        next_heartbeat_ = Clock::now() + std::chrono::milliseconds(heartbeat_);
        if (report_busy)
            report_busy(std::max<int64_t>(reached_ns(), 0));
    }

    std::string last_message() const
    {
        if (clock_ns_ < 0)
            return "; no message of its clock has arrived on " + options_.name(options_.clock_topic);
        double silent_s = std::chrono::duration<double>(Clock::now() - clock_at_).count();
        char text[120];
        std::snprintf(text, sizeof text, "; Gazebo's clock is at %s, received %.1f s ago",
                      seconds(clock_ns_).c_str(), silent_s);
        return text;
    }

    bool has_service(const std::string &service) const
    {
        std::vector<transport::ServicePublisher> publishers;
        return node_.ServiceInfo(service, publishers) && !publishers.empty();
    }

    std::string list_worlds() const
    {
        std::vector<std::string> services;
        node_.ServiceList(services);
        std::string worlds;
        for (const std::string &service : services)
            if (service.rfind("/world/", 0) == 0 && service.size() > 15 &&
                service.compare(service.size() - 8, 8, "/control") == 0)
                worlds += (worlds.empty() ? "" : ", ") + service.substr(7, service.size() - 15);
        return worlds.empty() ? "no world is visible; check IGN_PARTITION and IGN_IP (GZ_ in newer versions), or the "
                                "options partition and ip"
                              : "visible worlds: " + worlds;
    }

    void connect()
    {
        std::string clock = options_.name(options_.clock_topic), poses = options_.name(options_.pose_topic);
        std::function<void(const msgs::Clock &)> on_clock = [this](const msgs::Clock &message) { receive(message); };
        std::function<void(const msgs::Pose_V &)> on_poses = [this](const msgs::Pose_V &message) { receive(message); };
        std::function<void(const msgs::Empty &)> on_passed = [this](const msgs::Empty &) {
            std::lock_guard<std::mutex> guard(mutex_);
            passed_++;
            changed_.notify_all();
        };
        if (!node_.Subscribe(clock, on_clock) || !node_.Subscribe(poses, on_poses) ||
            !node_.Subscribe(options_.name(options_.fence_answer), on_passed))
            fail("a topic has an invalid name: " + clock + ", " + poses);
        fence_ = node_.Advertise<msgs::Empty>(options_.name(options_.fence_topic));
        for (Agent &agent : agents_) {
            agent.publisher = node_.Advertise<msgs::Twist>(command_topic(agent));
            if (!agent.publisher)
                fail("the topic " + command_topic(agent) + " has an invalid name");
        }
        std::string control = control_service();
        std::unique_lock<std::mutex> lock(mutex_);
        wait(lock, [&] { return unlocked(lock, [&] { return has_service(control); }); },
             [&] { return "the service " + control + " has not been found (" + list_worlds() + ")"; });
        is_connected_ = true;
        wait(lock, [&] { return clock_ns_ >= 0; }, [] { return std::string("its clock has not been received"); });
        wait(lock, [&] { return pose_ns_ >= 0; },
             [&] { return "no poses have been received on " + poses + "; the world needs the SceneBroadcaster plugin"; });
        std::string missing;
        for (const Agent &agent : agents_)
            if (!present_.count(agent.model))
                missing += (missing.empty() ? "" : ", ") + agent.model;
        if (!missing.empty())
            fail("it has no moving model " + missing + " (models and links: " + names_ +
                 "); write the world with `fieldkit cosim sdf`, or set physics.options.models");
        wait_for_subscribers(lock);
    }

    /* Evaluate without the lock, because Gazebo Transport holds its own lock during callbacks. */
    template <typename Function> static bool unlocked(std::unique_lock<std::mutex> &lock, Function function)
    {
        lock.unlock();
        bool result = function();
        lock.lock();
        return result;
    }

    void wait_for_subscribers(std::unique_lock<std::mutex> &lock)
    {
        const Agent *missing = nullptr;
        auto all_connected = [&] {
            for (Agent &agent : agents_)
                if (!agent.publisher.HasConnections())
                    return missing = &agent, false;
            return true;
        };
        wait(lock, [&] { return unlocked(lock, all_connected); }, [&] {
            return "nothing subscribes to the commands of " + missing->name + " on " + command_topic(*missing) +
                   " (its model needs the plugin DiffDrive or VelocityControl)";
        });
        std::vector<transport::MessagePublisher> publishers;
        auto has_fence = [&] {
            node_.TopicInfo(options_.name(options_.fence_answer), publishers);
            return !publishers.empty() && fence_.HasConnections();
        };
        uses_fence_ = options_.acknowledge != "off" && unlocked(lock, has_fence);
        if (options_.acknowledge == "required")
            wait(lock, [&] { return uses_fence_ || (uses_fence_ = unlocked(lock, has_fence)); }, [&] {
                return "there is no TriggeredPublisher from " + options_.name(options_.fence_topic) + " to " +
                       options_.name(options_.fence_answer);
            });
    }

    void receive(const msgs::Clock &message)
    {
        std::lock_guard<std::mutex> guard(mutex_);
        int64_t time_ns = message.sim().sec() * 1000000000LL + message.sim().nsec();
        same_clocks_ = time_ns == clock_ns_ ? same_clocks_ + 1 : 0;
        clock_at_ = Clock::now();
        if (time_ns == clock_ns_ && same_clocks_ > 3)
            return; /* a paused world repeats its clock */
        clock_ns_ = time_ns;
        changed_.notify_all();
    }

    void receive(const msgs::Pose_V &message)
    {
        std::lock_guard<std::mutex> guard(mutex_);
        const auto &stamp = message.header().stamp();
        int64_t time_ns = stamp.sec() * 1000000000LL + stamp.nsec();
        if (time_ns == pose_ns_)
            return; /* a paused world repeats its poses */
        pose_ns_ = time_ns;
        present_.clear();
        names_.clear();
        for (const msgs::Pose &pose : message.pose()) {
            if (names_.size() < 200)
                names_ += (names_.empty() ? "" : ", ") + pose.name();
            auto model = by_model_.find(pose.name());
            if (model == by_model_.end() || !present_.insert(pose.name()).second)
                continue; /* a link may have the name of a model; models come first */
            const auto &p = pose.position();
            const auto &q = pose.orientation();
            poses_[model->second] = Pose{{p.x(), p.y(), p.z()}, q.w(), q.x(), q.y(), q.z()};
        }
        changed_.notify_all();
    }

    /* The answer of a service: -1 before it arrives, else 0 or 1. */
    using Answer = std::shared_ptr<int>;

    template <typename Request> Answer send(const std::string &service, const Request &request)
    {
        auto answer = std::make_shared<int>(-1);
        std::function<void(const msgs::Boolean &, const bool)> on_answer = [this, answer](const msgs::Boolean &value,
                                                                                         const bool is_valid) {
            std::lock_guard<std::mutex> guard(mutex_);
            *answer = is_valid && value.data();
            changed_.notify_all();
        };
        if (!node_.Request(service, request, on_answer))
            fail("the service " + service + " cannot be called");
        return answer;
    }

    void check(const Answer &answer, const std::string &service) const
    {
        if (*answer == 0)
            fail("the service " + service + " has refused the request");
    }

    /* Send a request that may arrive twice, and wait for its answer. The first answer to a new process may be lost, as
     * Gazebo Transport does not wait until its connection is complete; so the request is repeated. */
    template <typename Request> void call(const std::string &service, const Request &request)
    {
        Answer answer = send(service, request);
        auto repeat_at = Clock::now() + std::chrono::seconds(1);
        std::unique_lock<std::mutex> lock(mutex_);
        wait(lock,
             [&] {
                 if (*answer < 0 && Clock::now() > repeat_at) {
                     repeat_at = Clock::now() + std::chrono::seconds(1);
                     lock.unlock();
                     answer = send(service, request);
                     lock.lock();
                 }
                 return *answer >= 0;
             },
             [&] { return "the service " + service + " has not answered"; });
        check(answer, service);
    }

    msgs::WorldControl control_request(uint32_t steps, bool resets = false) const
    {
        msgs::WorldControl request;
        request.set_pause(true); /* a request without it would let the world run */
        request.set_multi_step(steps);
        if (resets)
            request.mutable_reset()->set_all(true);
        return request;
    }

    std::string control_service() const { return options_.name(options_.control_service); }

    void pause()
    {
        call(control_service(), control_request(0));
        std::unique_lock<std::mutex> lock(mutex_);
        same_clocks_ = 0;
        wait(lock, [&] { return same_clocks_ >= 3; },
             [] { return std::string("it has not paused, another program may run it"); });
        now_ns_ = clock_ns_;
    }

    void measure_step()
    {
        int64_t before_ns = now_ns_;
        Answer answer = send(control_service(), control_request(1));
        std::unique_lock<std::mutex> lock(mutex_);
        wait(lock, [&] { return clock_ns_ > before_ns; }, [] { return std::string("it has not made a step"); });
        step_ns_ = clock_ns_ - before_ns;
        wait_for_poses(lock, before_ns + step_ns_, before_ns, answer);
    }

    /* Advance by a number of steps: the poses are those after the last one. */
    void step(int64_t count)
    {
        while (count > 0) {
            uint32_t steps = static_cast<uint32_t>(std::min<int64_t>(count, 1000000));
            {
                std::lock_guard<std::mutex> guard(mutex_);
                if (clock_ns_ != now_ns_)
                    fail(clock_ns_ < now_ns_ ? "it was reset" + last_message()
                                             : "another program has advanced it" + last_message());
            }
            int64_t before_ns = now_ns_;
            Answer answer = send(control_service(), control_request(steps));
            std::unique_lock<std::mutex> lock(mutex_);
            wait_for_poses(lock, before_ns + steps * step_ns_, before_ns, answer);
            count -= steps;
        }
        for (size_t i = 0; i < agents_.size(); i++)
            agents_[i].pose = poses_[i];
    }

    /* The clock of a step is published before the step is made, so only poses with its time stamp are valid. */
    void wait_for_poses(std::unique_lock<std::mutex> &lock, int64_t target_ns, int64_t before_ns, const Answer &answer)
    {
        wait(lock,
             [&] {
                 check(answer, control_service());
                 if (clock_ns_ > target_ns || pose_ns_ > target_ns)
                     fail("it has advanced beyond Gazebo's time " + seconds(target_ns) +
                          ", another program may control it" + last_message());
                 if (clock_ns_ < before_ns)
                     fail("it was reset" + last_message());
                 return pose_ns_ == target_ns;
             },
             [&]() -> std::string {
                 if (clock_ns_ == target_ns)
                     return "no poses of Gazebo's time " + seconds(target_ns) + " have arrived on " +
                            options_.name(options_.pose_topic) + " (the last ones are of " +
                            seconds(pose_ns_) + "; is dynamic_pose_hertz too small?)";
                 return "it has not reached Gazebo's time " + seconds(target_ns) + ", another program may have paused it";
             });
        now_ns_ = target_ns;
        for (const Agent &agent : agents_)
            if (!present_.count(agent.model))
                fail("the model " + agent.model + " has been removed");
    }

    /* Robots may still move from an earlier run, and a new position keeps the velocity. */
    void come_to_rest(int64_t steps)
    {
        step(steps);
        for (int round = 0; round < 20; round++) {
            std::vector<Pose> before = poses_of_agents();
            step(std::max<int64_t>(steps / 4, 1));
            double moved = 0;
            for (size_t i = 0; i < agents_.size(); i++) {
                const Pose &p = agents_[i].pose, &q = before[i];
                moved = std::max({moved, std::fabs(p.position.x - q.position.x), std::fabs(p.position.y - q.position.y),
                                  std::fabs(p.position.z - q.position.z),
                                  std::fabs(std::remainder(p.yaw() - q.yaw(), 2 * M_PI))});
            }
            if (moved < 1e-4)
                return;
        }
    }

    void reset()
    {
        call(control_service(), control_request(0, true));
        std::unique_lock<std::mutex> lock(mutex_);
        wait(lock, [&] { return clock_ns_ == 0; },
             [] { return std::string("its clock has not returned to 0 after a reset (option reset: false avoids it)"); });
        wait(lock, [&] { return pose_ns_ == 0; }, [] { return std::string("no poses have arrived after a reset"); });
        now_ns_ = 0;
        /* Newer versions create the plugins again, which then subscribe again. */
        wait_for_subscribers(lock);
    }

    void place()
    {
        for (const Agent &agent : agents_) {
            msgs::Pose pose;
            pose.set_name(agent.model);
            pose.mutable_position()->set_x(agent.start.x);
            pose.mutable_position()->set_y(agent.start.y);
            pose.mutable_position()->set_z(agent.start.z);
            pose.mutable_orientation()->set_w(std::cos(agent.start_yaw / 2));
            pose.mutable_orientation()->set_z(std::sin(agent.start_yaw / 2));
            call(options_.name(options_.pose_service), pose);
        }
        /* The service answers before it places the model, which happens at the latest before the next step. */
    }

    void check_start()
    {
        for (const Agent &agent : agents_) {
            const Vector &p = agent.pose.position, &q = agent.start;
            double distance_m = std::sqrt((p.x - q.x) * (p.x - q.x) + (p.y - q.y) * (p.y - q.y) + (p.z - q.z) * (p.z - q.z));
            if (!(distance_m <= options_.start_error_m))
                fail("the model " + agent.model + " is " + std::to_string(distance_m) +
                     " m away from the start of " + agent.name +
                     "; write the world with `fieldkit cosim sdf`, or set physics.options.place or origins_m");
        }
    }

    /* Messages to a topic and requests to a service have no order between them. The plugin TriggeredPublisher answers
     * a message that follows the commands on the same connection; without it, Gazebo's single thread of reception
     * accepts one message and one request in turns, so that it has probably read the commands after that many
     * requests. */
    void acknowledge()
    {
        if (uses_fence_) {
            std::unique_lock<std::mutex> lock(mutex_);
            uint64_t expected = passed_ + 1;
            lock.unlock();
            fence_.Publish(msgs::Empty());
            lock.lock();
            wait(lock, [&] { return passed_ >= expected; },
                 [&] { return "commands have not been acknowledged on " + options_.name(options_.fence_answer); });
            return;
        }
        if (options_.acknowledge != "off")
            for (size_t i = 0; i <= agents_.size(); i++)
                call(control_service(), control_request(0));
    }

    bool any_turns() const
    {
        return std::any_of(agents_.begin(), agents_.end(), [](const Agent &agent) {
            return agent.command == VELOCITY && !std::isnan(agent.values[3]) &&
                   std::fabs(std::remainder(agent.values[3] - agent.pose.yaw(), 2 * M_PI)) > 1e-3;
        });
    }

    /* The command as Gazebo's plugins expect it, in the axes of the model. */
    msgs::Twist twist_of(const Agent &agent) const
    {
        msgs::Twist twist;
        if (!agent.flies) {
            twist.mutable_linear()->set_x(agent.values[0]);
            twist.mutable_angular()->set_z(agent.values[1]);
            return twist;
        }
        /* VelocityControl sets the velocity before each step, and gravity changes it in the step. */
        double fall_m_s = options_.gravity_m_s2 * double(step_ns_) / 1e9;
        Vector velocity = agent.pose.inverse_rotated({agent.values[0], agent.values[1], agent.values[2] + fall_m_s});
        twist.mutable_linear()->set_x(velocity.x);
        twist.mutable_linear()->set_y(velocity.y);
        twist.mutable_linear()->set_z(velocity.z);
        if (!std::isnan(agent.values[3])) {
            double error = std::remainder(agent.values[3] - agent.pose.yaw(), 2 * M_PI);
            if (std::fabs(error) > 1e-3)
                twist.mutable_angular()->set_z(options_.yaw_gain_per_s * error);
        }
        return twist;
    }

    std::vector<Pose> poses_of_agents() const
    {
        std::vector<Pose> poses;
        for (const Agent &agent : agents_)
            poses.push_back(agent.pose);
        return poses;
    }

    Options options_;
    std::vector<Agent> agents_;
    int heartbeat_;
    Clock::time_point next_heartbeat_ = Clock::now();
    std::map<std::string, size_t> by_model_;
    int64_t step_ns_ = 0, now_ns_ = -1, start_ns_ = 0, window_at_ = 0;
    std::vector<Pose> window_poses_;
    bool is_connected_ = false, uses_fence_ = false;

    std::mutex mutex_; /* for what the callbacks write */
    std::condition_variable changed_;
    int64_t clock_ns_ = -1, pose_ns_ = -1;
    int same_clocks_ = 0;
    Clock::time_point clock_at_;
    uint64_t passed_ = 0;
    std::vector<Pose> poses_;
    std::set<std::string> present_;
    std::string names_;
    transport::Node::Publisher fence_;
    transport::Node node_; /* last: its callbacks use the other members */
};

/* ---- The federate ---- */

class Federate {
public:
    Federate(int input, int output) : input_(input), output_(output) {}

    int serve()
    {
        std::string header(16, '\0');
        while (read_all(header)) {
            Reader fields(reinterpret_cast<const uint8_t *>(header.data()), header.size());
            uint32_t size = static_cast<uint32_t>(fields.number(4));
            int kind = static_cast<int>(fields.number(2));
            addressing_ = header.substr(8);
            std::string body(size <= MAX_FRAME_BYTES ? size : 0, '\0');
            if (size > MAX_FRAME_BYTES || !read_all(body))
                return 2;
            if (kind == BYE)
                break;
            if (kind == RELEASE)
                continue;
            Reader reader(reinterpret_cast<const uint8_t *>(body.data()), body.size());
            Writer answer;
            try {
                send(static_cast<Kind>(handle(kind, reader, answer)), answer);
            } catch (const std::exception &error) {
                Writer text;
                text.text(error.what());
                send(ERROR, text);
                break;
            }
        }
        if (gazebo_)
            gazebo_->stop();
        return 0;
    }

private:
    int handle(int kind, Reader &reader, Writer &answer)
    {
        switch (kind) {
        case HELLO:
            hello(reader, answer);
            return WELCOME;
        case ADVANCE_PHYSICS:
            advance(reader, answer);
            return STATES;
        case PING:
            answer.number(reader.number(8), 8);
            return PONG;
        default:
            throw Failure("the request is not supported");
        }
    }

    void hello(Reader &reader, Writer &answer)
    {
        if (gazebo_)
            throw Failure("hello was sent twice");
        if (std::memcmp(reader.bytes(8), "FIELDKIT", 8) != 0 || reader.number(2) != VERSION)
            throw Failure("this is not version 1 of the protocol");
        if (reader.number(1) != PHYSICS)
            throw Failure("this federate is a physics");
        reader.bytes(1);
        int heartbeat_ms = static_cast<int>(std::clamp<uint64_t>(reader.number(4), 1, 60000));
        reader.bytes(8 + 8 + 8); /* seed, step, end */
        std::string hash(reinterpret_cast<const char *>(reader.bytes(32)), 32);
        reader.text(); /* token */
        reader.text(); /* name of the scenario */
        std::vector<Agent> agents(reader.count(85));
        for (Agent &agent : agents) {
            agent.name = reader.text();
            reader.text(); /* profile */
            agent.flies = reader.number(1) != 0;
            agent.command = agent.flies ? VELOCITY : TWIST;
            agent.values[1] = 0;
            agent.antenna.z = reader.real();
            reader.bytes(8);
            agent.start = {reader.real(), reader.real(), reader.real()};
            reader.bytes(24);
            double heading = reader.real();
            agent.start_yaw = std::isnan(heading) ? 0 : heading;
            reader.bytes(8);
        }
        uint32_t size = reader.count(1);
        const char *text = reinterpret_cast<const char *>(reader.bytes(size));
        reader.end();
        Json configuration = Json::parse(text, text + size);
        Options options(configuration.value("options", Json::object()));
        if (options.world.empty())
            options.world = configuration.at("world").at("name").get<std::string>();
        for (Agent &agent : agents) {
            auto model = options.models.find(agent.name);
            agent.model = model == options.models.end() ? agent.name : model->second;
            auto origin = options.origins_m.find(agent.name);
            if (origin != options.origins_m.end()) {
                if (origin->second.size() != 3)
                    throw Failure("physics.options.origins_m of " + agent.name + " needs three numbers");
                agent.antenna.x += origin->second[0];
                agent.antenna.y += origin->second[1];
                agent.antenna.z += origin->second[2];
            }
            Vector offset = Pose{{}, std::cos(agent.start_yaw / 2), 0, 0, std::sin(agent.start_yaw / 2)}.rotated(agent.antenna);
            agent.start = {agent.start.x - offset.x, agent.start.y - offset.y, agent.start.z - offset.z};
        }
        for (auto [name, value] : {std::pair<std::string, std::string>{"IP", options.ip}, {"PARTITION", options.partition}})
            if (!value.empty()) {
                setenv(("IGN_" + name).c_str(), value.c_str(), 1);
                setenv(("GZ_" + name).c_str(), value.c_str(), 1);
            }
        limit_m_s2_ = options.limit_m_s2;
        bool is_deterministic = options.deterministic;
        auto report_busy = [this](int64_t at_ns) {
            Writer busy;
            busy.number(static_cast<uint64_t>(at_ns), 8);
            send(BUSY, busy);
        };
        report_busy(0); /* the first use of Gazebo Transport takes a while */
        gazebo_ = std::make_unique<Gazebo>(std::move(options), std::move(agents), heartbeat_ms);
        gazebo_->report_busy = report_busy;
        gazebo_->begin();
        answer.number(VERSION, 2);
        answer.number(PHYSICS, 1);
        answer.number(0, 1);
        answer.number(is_deterministic ? DETERMINISTIC : 0, 4);
        answer.number(static_cast<uint64_t>(gazebo_->step_ns()), 8);
        answer.number(UINT64_MAX, 8); /* next_event_ns: -1 */
        answer.data += hash;
        answer.text("gazebo");
        answer.text(SOFTWARE);
        answer.number(2, 2);
        answer.number(TWIST, 2);
        answer.number(VELOCITY, 2);
        answer.number(0, 2); /* transports */
        answer.number(0, 4); /* transmitters */
        answer.number(0, 4); /* emitters */
    }

    struct Command {
        uint32_t agent;
        int type;
        double values[4];
    };

    void advance(Reader &reader, Writer &answer)
    {
        int64_t to_ns = reader.time(), from_ns = reader.time();
        if (!gazebo_)
            throw Failure("hello is missing");
        std::vector<Agent> &agents = gazebo_->agents();
        std::vector<Command> commands(reader.count(8));
        for (Command &command : commands) {
            command = {static_cast<uint32_t>(reader.number(4)), static_cast<int>(reader.number(2)), {0, 0, 0, NAN}};
            size_t size = reader.number(2);
            if (command.agent >= agents.size())
                throw Failure("a command is to an agent that was not announced");
            const Agent &agent = agents[command.agent];
            if (!(command.type == TWIST && size == 16) && !(command.type == VELOCITY && size == 32))
                throw Failure("a command has an unknown type");
            if ((command.type == VELOCITY) != agent.flies)
                throw Failure("a command to " + agent.name + " has the wrong type");
            for (size_t i = 0; i < size / 8; i++)
                command.values[i] = reader.real();
        }
        reader.end();
        if (to_ns < to_ns_ || from_ns > to_ns)
            throw Failure("time runs backwards: " + seconds(to_ns_) + " to " + seconds(to_ns));
        to_ns_ = to_ns;
        int64_t step_ns = gazebo_->step_ns();
        if (!commands.empty()) {
            apply_pending(from_ns); /* earlier commands apply until then */
            pending_.insert(pending_.end(), commands.begin(), commands.end());
            pending_step_ = (from_ns + step_ns - 1) / step_ns;
        }
        apply_pending(to_ns);
        gazebo_->advance(to_ns / step_ns);
        answer.number(static_cast<uint64_t>(to_ns - to_ns % step_ns), 8);
        answer.number(0, 4); /* no new agents */
        answer.number(agents.size(), 4);
        for (size_t i = 0; i < agents.size(); i++)
            put_state(answer, i, agents[i]);
    }

    /* Apply the commands that wait for a step, if it is before a time or begins at it. */
    void apply_pending(int64_t to_ns)
    {
        if (pending_.empty() || pending_step_ > to_ns / gazebo_->step_ns())
            return;
        gazebo_->advance(pending_step_);
        for (const Command &command : pending_) {
            Agent &agent = gazebo_->agents()[command.agent];
            agent.command = command.type;
            std::copy(command.values, command.values + 4, agent.values);
        }
        pending_.clear();
        gazebo_->send_commands();
    }

    void put_state(Writer &answer, size_t index, const Agent &agent) const
    {
        answer.number(index, 4);
        answer.number(0, 4);
        Vector position = Gazebo::antenna_of(agent, agent.pose);
        for (double value : {position.x, position.y, position.z, agent.velocity.x, agent.velocity.y, agent.velocity.z,
                             agent.pose.yaw(), limit_m_s2_})
            answer.real(value);
    }

    bool read_all(std::string &data)
    {
        for (size_t at = 0; at < data.size();) {
            ssize_t count = read(input_, &data[at], data.size() - at);
            if (count <= 0)
                return false;
            at += static_cast<size_t>(count);
        }
        return true;
    }

    void send(Kind kind, const Writer &body)
    {
        Writer frame;
        frame.number(body.data.size(), 4);
        frame.number(kind, 2);
        frame.number(0, 2);
        frame.data += addressing_ + body.data;
        for (size_t at = 0; at < frame.data.size();) {
            ssize_t count = write(output_, frame.data.data() + at, frame.data.size() - at);
            if (count <= 0)
                _exit(1); /* the coordinator has closed the connection */
            at += static_cast<size_t>(count);
        }
    }

    int input_, output_;
    std::string addressing_; /* request and copy of the header */
    std::unique_ptr<Gazebo> gazebo_;
    std::vector<Command> pending_;
    int64_t pending_step_ = 0, to_ns_ = 0;
    double limit_m_s2_ = 0;
};

int main()
{
    int output = dup(STDOUT_FILENO);
    dup2(STDERR_FILENO, STDOUT_FILENO); /* what a library prints must not damage the protocol */
    return Federate(STDIN_FILENO, output).serve();
}
