/* A server with the services and topics of Gazebo Fortress, for tests: DART moves the models of an SDF file.
 *
 * It follows the loop of Fortress (ign-gazebo6, SimulationRunner). The services that control the world and that create
 * and remove models answer before the request is executed. The clock of a step is published before the step is made.
 * Poses are published at a limited rate in wall time. A request without `pause` starts the world. A reset sets the
 * time to 0 without moving the models. DART clears commands to joints after each step. Unlike Fortress, a world that
 * has been paused for some time iterates less often until the next request, so that an idle server uses almost no
 * processor time.
 *
 *     gazebo_server WORLD.sdf [--reset world] [--fault KIND@SECONDS]
 *
 * With `--reset world`, a reset builds the world and its plugins again, as in later versions. A fault is an action of
 * another program at a simulated time: `pause`, `reset`, `step` (one more step than requested), `remove` (the first
 * model that moves), `exit`. `late-clock`: from this time on the clock of a step arrives 5 ms after its poses.
 * `lost-commands`: from this time on commands are lost, up to and including the message that follows them. */

#include <ignition/msgs/boolean.pb.h>
#include <ignition/msgs/clock.pb.h>
#include <ignition/msgs/empty.pb.h>
#include <ignition/msgs/entity.pb.h>
#include <ignition/msgs/entity_factory.pb.h>
#include <ignition/msgs/pose.pb.h>
#include <ignition/msgs/pose_v.pb.h>
#include <ignition/msgs/twist.pb.h>
#include <ignition/msgs/world_control.pb.h>
#include <ignition/physics/ForwardStep.hh>
#include <ignition/physics/FrameSemantics.hh>
#include <ignition/physics/FreeGroup.hh>
#include <ignition/physics/GetEntities.hh>
#include <ignition/physics/Joint.hh>
#include <ignition/physics/RemoveEntities.hh>
#include <ignition/physics/RequestEngine.hh>
#include <ignition/physics/sdf/ConstructModel.hh>
#include <ignition/physics/sdf/ConstructWorld.hh>
#include <ignition/plugin/Loader.hh>
#include <ignition/transport/Node.hh>
#include <sdf/sdf.hh>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <csignal>
#include <cstring>
#include <filesystem>
#include <iostream>
#include <memory>
#include <mutex>
#include <thread>

namespace physics = ignition::physics;
namespace msgs = ignition::msgs;
namespace transport = ignition::transport;
using Features = physics::FeatureList<physics::sdf::ConstructSdfWorld, physics::sdf::ConstructSdfModel,
                                      physics::RemoveEntities, physics::GetEntities, physics::ForwardStep,
                                      physics::LinkFrameSemantics, physics::GetBasicJointState,
                                      physics::SetJointVelocityCommandFeature, physics::FindFreeGroupFeature,
                                      physics::SetFreeGroupWorldPose, physics::SetFreeGroupWorldVelocity>;
using SteadyClock = std::chrono::steady_clock;

/* Return the path of DART's plugin; its folder depends on the architecture. */
static std::string engine_path()
{
    for (const auto &folder : std::filesystem::directory_iterator("/usr/lib")) {
        auto path = folder.path() / "ign-physics-5/engine-plugins/libignition-physics5-dartsim-plugin.so.5";
        if (std::filesystem::exists(path))
            return path.string();
    }
    return "";
}

/* ACTIVE_PERIOD is longer than the period of the slowest poses in the tests, 60 Hz. */
static constexpr auto ACTIVE_PERIOD = std::chrono::milliseconds(40), IDLE_PERIOD = std::chrono::milliseconds(5);

static volatile std::sig_atomic_t is_stopped = 0;

/* ignition::math::SpeedLimiter without jerk. */
struct Limiter {
    double max_speed = 1e9, max_acceleration = 1e9, current_speed = 0;
    double limit(double target, double step_s)
    {
        target = std::clamp(target, -max_speed, max_speed);
        current_speed += std::clamp(target - current_speed, -max_acceleration * step_s, max_acceleration * step_s);
        return current_speed;
    }
};

struct Model {
    std::string name;
    physics::Model3dPtr<Features> body;
    physics::Link3dPtr<Features> link;
    std::vector<physics::Joint3dPtr<Features>> left_joints, right_joints;
    bool drives = false, flies = false, has_target = false;
    double wheel_separation = 1, wheel_radius = 1, left_speed = 0, right_speed = 0;
    Limiter linear, angular;
    std::mutex mutex; /* for the target, which is set by the receiving thread */
    Eigen::Vector3d target_linear = Eigen::Vector3d::Zero(), target_angular = Eigen::Vector3d::Zero();
    Eigen::Vector3d applied_linear = Eigen::Vector3d::Zero(), applied_angular = Eigen::Vector3d::Zero();

    void on_twist(const msgs::Twist &twist)
    {
        std::lock_guard<std::mutex> guard(mutex);
        target_linear = {twist.linear().x(), twist.linear().y(), twist.linear().z()};
        target_angular = {twist.angular().x(), twist.angular().y(), twist.angular().z()};
    }

    void pre_update()
    {
        if (flies) {
            auto group = body->FindFreeGroup();
            Eigen::Matrix3d rotation = link->FrameDataRelativeToWorld().pose.linear();
            group->SetWorldLinearVelocity(rotation * applied_linear);
            group->SetWorldAngularVelocity(rotation * applied_angular);
        }
        for (auto &joint : left_joints)
            joint->SetVelocityCommand(0, left_speed);
        for (auto &joint : right_joints)
            joint->SetVelocityCommand(0, right_speed);
    }

    void post_update(double step_s)
    {
        std::lock_guard<std::mutex> guard(mutex);
        applied_linear = target_linear, applied_angular = target_angular;
        double forward = linear.limit(target_linear.x(), step_s);
        double yaw_rate = angular.limit(target_angular.z(), step_s);
        right_speed = (forward + yaw_rate * wheel_separation / 2) / wheel_radius;
        left_speed = (forward - yaw_rate * wheel_separation / 2) / wheel_radius;
    }
};

class Server {
public:
    Server(const std::string &path, bool resets_world, std::string fault, double fault_s)
        : resets_world_(resets_world), fault_(std::move(fault)), fault_ns_(std::llround(fault_s * 1e9))
    {
        sdf::Errors errors = root_.Load(path);
        for (const auto &error : errors)
            std::cerr << error.Message() << std::endl;
        if (!errors.empty() || root_.WorldCount() != 1)
            std::exit(2);
        world_ = root_.WorldByIndex(0);
        topic_prefix_ = "/world/" + world_->Name();
        step_ns_ = std::llround(world_->PhysicsByIndex(0)->MaxStepSize() * 1e9);
        double factor = world_->PhysicsByIndex(0)->RealTimeFactor();
        period_ns_ = factor > 0 ? std::llround(double(step_ns_) / factor) : 0;
        loader_.LoadLib(engine_path());
        build();
        std::function<bool(const msgs::WorldControl &, msgs::Boolean &)> on_control =
            [this](const msgs::WorldControl &request, msgs::Boolean &answer) {
                std::lock_guard<std::mutex> guard(mutex_);
                controls_.push_back(request);
                request_arrived_.notify_all();
                answer.set_data(true);
                return true;
            };
        std::function<bool(const msgs::Pose &, msgs::Boolean &)> on_pose = [this](const msgs::Pose &request,
                                                                                  msgs::Boolean &answer) {
            std::lock_guard<std::mutex> guard(mutex_);
            poses_.push_back(request);
            request_arrived_.notify_all();
            answer.set_data(true);
            return true;
        };
        std::function<bool(const msgs::EntityFactory &, msgs::Boolean &)> on_create =
            [this](const msgs::EntityFactory &request, msgs::Boolean &answer) {
                std::lock_guard<std::mutex> guard(mutex_);
                creations_.push_back(request);
                request_arrived_.notify_all();
                answer.set_data(true);
                return true;
            };
        std::function<bool(const msgs::Entity &, msgs::Boolean &)> on_remove = [this](const msgs::Entity &request,
                                                                                      msgs::Boolean &answer) {
            std::lock_guard<std::mutex> guard(mutex_);
            removals_.push_back(request);
            request_arrived_.notify_all();
            answer.set_data(true);
            return true;
        };
        node_.Advertise(topic_prefix_ + "/create", on_create);
        node_.Advertise(topic_prefix_ + "/remove", on_remove);
        node_.Advertise(topic_prefix_ + "/control", on_control);
        node_.Advertise(topic_prefix_ + "/set_pose", on_pose);
        clock_publisher_ = node_.Advertise<msgs::Clock>(topic_prefix_ + "/clock");
        transport::AdvertiseMessageOptions options;
        options.SetMsgsPerSec(pose_rate_hz());
        pose_publisher_ = node_.Advertise<msgs::Pose_V>(topic_prefix_ + "/dynamic_pose/info", options);
    }

    void run()
    {
        std::cout << "ready" << std::endl;
        auto next = SteadyClock::now();
        while (!is_stopped) {
            iterate();
            next = std::max(next + std::chrono::nanoseconds(period_ns_), SteadyClock::now());
            if (!is_idle()) {
                std::this_thread::sleep_until(next);
                continue;
            }
            std::unique_lock<std::mutex> lock(mutex_);
            request_arrived_.wait_for(lock, IDLE_PERIOD, [this] {
                return !controls_.empty() || !poses_.empty() || !creations_.empty() || !removals_.empty();
            });
        }
    }

private:
    /* Return true if the world is paused and ACTIVE_PERIOD has passed since the last request or step. */
    bool is_idle()
    {
        if (!is_paused_ || resets_time_)
            last_active_ = SteadyClock::now();
        return SteadyClock::now() - last_active_ > ACTIVE_PERIOD;
    }

    static std::string value(sdf::ElementPtr element, const char *key)
    {
        return element->HasElement(key) ? element->GetElement(key)->Get<std::string>() : "";
    }

    static double number(sdf::ElementPtr element, const char *key, double fallback)
    {
        return element->HasElement(key) ? std::stod(value(element, key)) : fallback;
    }

    static void for_each_plugin(sdf::ElementPtr parent,
                                const std::function<void(const std::string &, sdf::ElementPtr)> &use_plugin)
    {
        if (!parent->HasElement("plugin"))
            return;
        for (auto plugin = parent->GetElement("plugin"); plugin; plugin = plugin->GetNextElement("plugin")) {
            std::string name = plugin->Get<std::string>("name");
            use_plugin(name.substr(name.rfind(':') + 1), plugin);
        }
    }

    int pose_rate_hz() const
    {
        int rate_hz = 60;
        for_each_plugin(world_->Element(), [&](const std::string &name, sdf::ElementPtr plugin) {
            if (name == "SceneBroadcaster")
                rate_hz = int(number(plugin, "dynamic_pose_hertz", 60));
        });
        return rate_hz;
    }

    /* Build the world, and subscribe its plugins to their topics. */
    void build()
    {
        plugin_node_.reset();
        models_.clear();
        removed_models_.clear();
        dart_ = nullptr;
        engine_ = nullptr;
        engine_ = physics::RequestEngine3d<Features>::From(loader_.Instantiate("ignition::physics::dartsim::Plugin"));
        dart_ = engine_->ConstructWorld(*world_);
        plugin_node_ = std::make_unique<transport::Node>();
        for (uint64_t i = 0; i < world_->ModelCount(); i++)
            if (!world_->ModelByIndex(i)->Static())
                add(*world_->ModelByIndex(i));
        for_each_plugin(world_->Element(), [&](const std::string &name, sdf::ElementPtr plugin) {
            if (name != "TriggeredPublisher")
                return;
            trigger_publisher_ =
                plugin_node_->Advertise<msgs::Empty>(plugin->GetElement("output")->Get<std::string>("topic"));
            std::function<void(const msgs::Empty &)> publish_trigger = [this](const msgs::Empty &message) {
                if (!loses_commands_.exchange(false))
                    trigger_publisher_.Publish(message);
            };
            plugin_node_->Subscribe(plugin->GetElement("input")->Get<std::string>("topic"), publish_trigger);
        });
    }

    void add(const sdf::Model &model_sdf)
    {
        auto model = std::make_unique<Model>();
        Model *model_pointer = model.get();
        model->name = model_sdf.Name();
        model->body = dart_->GetModel(model_sdf.Name());
        model->link = model->body->GetLink(0);
        for_each_plugin(model_sdf.Element(), [&](const std::string &name, sdf::ElementPtr plugin) {
            if (name == "DiffDrive") {
                model->drives = true;
                model->wheel_separation = number(plugin, "wheel_separation", 1);
                model->wheel_radius = number(plugin, "wheel_radius", 0.2);
                model->linear.max_speed = number(plugin, "max_linear_velocity", 1e9);
                model->linear.max_acceleration = number(plugin, "max_linear_acceleration", 1e9);
                model->angular.max_speed = number(plugin, "max_angular_velocity", 1e9);
                model->angular.max_acceleration = number(plugin, "max_angular_acceleration", 1e9);
                for (auto *side : {"left_joint", "right_joint"})
                    for (auto joint = plugin->GetElement(side); joint; joint = joint->GetNextElement(side))
                        (side[0] == 'l' ? model->left_joints : model->right_joints)
                            .push_back(model->body->GetJoint(joint->Get<std::string>()));
            } else if (name == "VelocityControl") {
                model->flies = true;
                auto initial = plugin->Get<ignition::math::Vector3d>("initial_linear", {0, 0, 0}).first;
                model->target_linear = model->applied_linear = {initial.X(), initial.Y(), initial.Z()};
            } else {
                return;
            }
            std::function<void(const msgs::Twist &)> on_twist = [this, model_pointer](const msgs::Twist &twist) {
                if (!loses_commands_)
                    model_pointer->on_twist(twist);
            };
            plugin_node_->Subscribe("/model/" + model_sdf.Name() + "/cmd_vel", on_twist);
        });
        models_.push_back(std::move(model));
    }

    void iterate()
    {
        if (resets_time_) {
            resets_time_ = false;
            time_ns_ = 0;
            if (resets_world_)
                build();
        } else if (!is_paused_) {
            time_ns_ += step_ns_;
        }
        if (!is_clock_late_)
            publish_clock();
        create_and_remove_models();
        place_models();
        if (!is_paused_) {
            for (auto &model : models_)
                model->pre_update();
            physics::ForwardStep::Output output;
            physics::ForwardStep::State state;
            physics::ForwardStep::Input input;
            input.Get<std::chrono::steady_clock::duration>() = std::chrono::nanoseconds(step_ns_);
            dart_->Step(output, state, input);
            for (auto &model : models_)
                model->post_update(double(step_ns_) / 1e9);
        }
        publish_poses();
        if (is_clock_late_) {
            std::this_thread::sleep_for(std::chrono::milliseconds(5));
            publish_clock();
        }
        if (!is_paused_ && pending_steps_ > 0 && --pending_steps_ == 0)
            is_paused_ = true;
        cause_fault();
        std::lock_guard<std::mutex> guard(mutex_);
        if (!controls_.empty())
            last_active_ = SteadyClock::now();
        for (const msgs::WorldControl &control : controls_) {
            is_paused_ = control.pause();
            uint32_t steps = control.multi_step() ? control.multi_step() : control.step() ? 1 : 0;
            if (is_paused_ && steps > 0)
                pending_steps_ += steps, is_paused_ = false;
            resets_time_ = control.has_reset() && (control.reset().all() || control.reset().time_only());
        }
        controls_.clear();
    }

    void cause_fault()
    {
        if (fault_.empty() || time_ns_ < fault_ns_)
            return;
        if (fault_ == "pause")
            pending_steps_ = 0, is_paused_ = true;
        else if (fault_ == "reset")
            resets_time_ = true;
        else if (fault_ == "step")
            pending_steps_++, is_paused_ = false;
        else if (fault_ == "remove")
            remove(models_.front()->name);
        else if (fault_ == "exit")
            _exit(1);
        else if (fault_ == "late-clock")
            is_clock_late_ = true;
        else if (fault_ == "lost-commands")
            loses_commands_ = true;
        fault_.clear();
    }

    void create_and_remove_models()
    {
        std::vector<msgs::EntityFactory> creations;
        std::vector<msgs::Entity> removals;
        {
            std::lock_guard<std::mutex> guard(mutex_);
            creations.swap(creations_);
            removals.swap(removals_);
        }
        for (const msgs::Entity &removal : removals)
            remove(removal.name());
        for (const msgs::EntityFactory &creation : creations)
            create(creation);
    }

    void remove(const std::string &name)
    {
        for (auto model = models_.begin(); model != models_.end(); model++)
            if ((*model)->name == name) {
                plugin_node_->Unsubscribe("/model/" + name + "/cmd_vel");
                (*model)->body->Remove();
                removed_models_.push_back(std::move(*model)); /* a callback may still use it */
                models_.erase(model);
                return;
            }
        std::cerr << "there is no model " << name << std::endl;
    }

    void create(const msgs::EntityFactory &creation)
    {
        sdf::Root root;
        sdf::Errors errors =
            creation.sdf_filename().empty() ? root.LoadSdfString(creation.sdf()) : root.Load(creation.sdf_filename());
        for (const auto &model : models_)
            if (model->name == creation.name() && !creation.allow_renaming()) {
                std::cerr << "there is a model " << creation.name() << " already" << std::endl;
                return;
            }
        if (!errors.empty() || root.Model() == nullptr) {
            std::cerr << "the SDF of " << creation.name() << " has no model" << std::endl;
            return;
        }
        sdf::Model model_sdf = *root.Model();
        model_sdf.SetName(creation.name());
        dart_->ConstructModel(model_sdf);
        add(model_sdf);
        msgs::Pose pose = creation.pose();
        pose.set_name(creation.name());
        std::lock_guard<std::mutex> guard(mutex_);
        poses_.push_back(pose);
    }

    void place_models()
    {
        std::vector<msgs::Pose> poses;
        {
            std::lock_guard<std::mutex> guard(mutex_);
            poses.swap(poses_);
        }
        for (const msgs::Pose &pose : poses)
            for (auto &model : models_)
                if (model->name == pose.name()) {
                    Eigen::Isometry3d target = Eigen::Isometry3d::Identity();
                    const auto &p = pose.position();
                    const auto &q = pose.orientation();
                    target.translate(Eigen::Vector3d(p.x(), p.y(), p.z()));
                    target.rotate(Eigen::Quaterniond(q.w(), q.x(), q.y(), q.z()));
                    model->body->FindFreeGroup()->SetWorldPose(target);
                }
    }

    void publish_clock()
    {
        msgs::Clock message;
        message.mutable_sim()->set_sec(time_ns_ / 1000000000);
        message.mutable_sim()->set_nsec(int(time_ns_ % 1000000000));
        clock_publisher_.Publish(message);
    }

    void publish_poses()
    {
        if (!pose_publisher_.HasConnections())
            return;
        msgs::Pose_V message;
        message.mutable_header()->mutable_stamp()->set_sec(time_ns_ / 1000000000);
        message.mutable_header()->mutable_stamp()->set_nsec(int(time_ns_ % 1000000000));
        for (auto &model : models_) {
            auto pose = message.add_pose();
            auto world = model->link->FrameDataRelativeToWorld().pose;
            Eigen::Quaterniond rotation(world.linear());
            pose->set_name(model->name);
            pose->mutable_position()->set_x(world.translation().x());
            pose->mutable_position()->set_y(world.translation().y());
            pose->mutable_position()->set_z(world.translation().z());
            pose->mutable_orientation()->set_w(rotation.w());
            pose->mutable_orientation()->set_x(rotation.x());
            pose->mutable_orientation()->set_y(rotation.y());
            pose->mutable_orientation()->set_z(rotation.z());
        }
        /* After the models, Gazebo lists their links, with poses relative to the models. */
        message.add_pose()->set_name("chassis");
        pose_publisher_.Publish(message);
    }

    bool resets_world_;
    std::string fault_;
    bool is_clock_late_ = false;
    std::atomic<bool> loses_commands_ = false;
    int64_t fault_ns_, step_ns_ = 0, period_ns_ = 0, time_ns_ = 0;
    int64_t pending_steps_ = 0;
    bool is_paused_ = true, resets_time_ = false;
    std::string topic_prefix_;
    sdf::Root root_;
    const sdf::World *world_ = nullptr;
    ignition::plugin::Loader loader_;
    physics::Engine3dPtr<Features> engine_;
    physics::World3dPtr<Features> dart_;
    std::vector<std::unique_ptr<Model>> models_, removed_models_;
    std::mutex mutex_; /* for the requests */
    std::condition_variable request_arrived_;
    SteadyClock::time_point last_active_ = SteadyClock::now(); /* of the last request or step */
    std::vector<msgs::WorldControl> controls_;
    std::vector<msgs::Pose> poses_;
    std::vector<msgs::EntityFactory> creations_;
    std::vector<msgs::Entity> removals_;
    transport::Node::Publisher clock_publisher_, pose_publisher_, trigger_publisher_;
    std::unique_ptr<transport::Node> plugin_node_;
    transport::Node node_;
};

int main(int argc, char **argv)
{
    std::string fault;
    double fault_s = 0;
    bool resets_world = false;
    for (int i = 2; i + 1 < argc; i += 2) {
        std::string value = argv[i + 1];
        if (std::string(argv[i]) == "--reset")
            resets_world = value == "world";
        else if (std::string(argv[i]) == "--fault")
            fault = value.substr(0, value.find('@')), fault_s = std::stod(value.substr(value.find('@') + 1));
    }
    std::signal(SIGTERM, [](int) { is_stopped = 1; });
    Server(argv[1], resets_world, fault, fault_s).run();
    return 0;
}
