// The models of a world that a run creates, places, removes, and restores at its end.

#ifndef FIELDKIT_GAZEBO_WORLD_MODELS_H
#define FIELDKIT_GAZEBO_WORLD_MODELS_H

#include "connection.h"
#include "model_journal.h"

#include <optional>

namespace fieldkit
{

// Gazebo's services answer before they create, place or remove a model, which happens at the latest before the next
// step. A request that arrives twice has no further effect, because Gazebo ignores a request to create a model that
// exists, or to remove one that does not.
class WorldModels
{
  public:
    WorldModels(const Options& options, Connection& connection)
        : m_options(options),
          m_connection(connection)
    {
    }

    // If the last run in this world was killed, undo its changes. The coordinator shows the notes.
    void RestoreAfterKilledRun()
    {
        m_journal.emplace(m_connection.ProcessId(), m_options.world);
        Restoration restoration = m_journal->Read();
        for (const std::string& name : restoration.created)
        {
            Remove(name);
            std::fprintf(stderr, "note: an earlier run was killed; the model %s, which it may have created, is removed\n",
                         name.c_str());
        }
        for (const InitialModel& model : restoration.initial)
        {
            Create(model);
            std::fprintf(stderr, "note: an earlier run was killed; the model %s is created again if it was removed\n",
                         model.name.c_str());
        }
    }

    // Write what must be undone if this run is killed.
    void WriteJournal(const std::vector<Agent>& agents)
    {
        Restoration restoration;
        for (const Agent& agent : agents)
        {
            if (agent.HasLifetime() && !agent.had_model)
            {
                restoration.created.push_back(agent.model);
            }
            else if (agent.HasLifetime())
            {
                restoration.initial.push_back(InitialModelOf(agent));
            }
        }
        if (restoration.created.empty() && restoration.initial.empty())
        {
            m_journal->Delete();
            return;
        }
        m_journal->Write(restoration);
    }

    // Place the model of an agent at its start.
    void Place(const Agent& agent)
    {
        m_connection.Call(m_options.Name(m_options.pose_service), PoseOf(agent.model, agent.start, agent.start_yaw));
    }

    void Create(const Agent& agent)
    {
        Create(InitialModelOf(agent));
    }

    void Remove(const std::string& name)
    {
        msgs::Entity request;
        request.set_name(name);
        request.set_type(msgs::Entity::MODEL);
        m_connection.Call(m_options.Name(m_options.remove_service), request);
    }

    // Remove the models that this run has created, and create those that it has removed.
    void Restore(const std::vector<Agent>& agents)
    {
        for (const Agent& agent : agents)
        {
            if (agent.is_present && !agent.had_model)
            {
                Remove(agent.model);
            }
            else if (agent.had_model && !agent.is_present)
            {
                Create(agent);
            }
        }
        if (m_journal)
        {
            m_journal->Delete();
        }
    }

  private:
    void Create(const InitialModel& model)
    {
        msgs::EntityFactory request;
        if (!model.file.empty())
        {
            request.set_sdf_filename(model.file);
        }
        else
        {
            request.set_sdf(model.sdf);
        }
        request.set_name(model.name);
        *request.mutable_pose() = PoseOf(model.name, model.position, model.yaw);
        m_connection.Call(m_options.Name(m_options.create_service), request);
    }

    InitialModel InitialModelOf(const Agent& agent) const
    {
        InitialModel model;
        model.name = agent.model;
        auto file = m_options.model_files.find(agent.name);
        if (file != m_options.model_files.end())
        {
            model.file = file->second;
        }
        else
        {
            model.sdf = m_options.sdf.at(agent.name);
        }
        model.position = agent.start;
        model.yaw = agent.start_yaw;
        return model;
    }

    static msgs::Pose PoseOf(const std::string& name, const Vector& position, double yaw)
    {
        Pose rotation = Pose::WithYaw(yaw);
        msgs::Pose pose;
        pose.set_name(name);
        pose.mutable_position()->set_x(position.x);
        pose.mutable_position()->set_y(position.y);
        pose.mutable_position()->set_z(position.z);
        pose.mutable_orientation()->set_w(rotation.w);
        pose.mutable_orientation()->set_z(rotation.z);
        return pose;
    }

    const Options& m_options;
    Connection& m_connection;
    std::optional<ModelJournal> m_journal;
};

} // namespace fieldkit

#endif
