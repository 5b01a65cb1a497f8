// A file with the requests that restore the models of a world. It remains if the process of a run is killed.

#ifndef FIELDKIT_GAZEBO_MODEL_JOURNAL_H
#define FIELDKIT_GAZEBO_MODEL_JOURNAL_H

#include "options.h"
#include "pose.h"

#include <cerrno>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <functional>

namespace fieldkit
{

// A model with its initial pose and the description from which it can be created.
struct InitialModel
{
    std::string name;
    std::string sdf, file; // its description, or the file of its description
    Vector position;
    double yaw = 0;
};

// The changes of a run that must be undone after it.
struct Restoration
{
    std::vector<std::string> created; // models that the run may have created
    std::vector<InitialModel> initial; // models that the run may have removed
};

// Journal of the runs in one world of one process of Gazebo; if Gazebo is restarted, its worlds have new journals.
class ModelJournal
{
  public:
    // `process` is the unique id that the process has generated at its start, and `world` is the name of its world.
    ModelJournal(const std::string& process, const std::string& world)
    {
        const char* base = std::getenv("XDG_CACHE_HOME");
        const char* home = std::getenv("HOME");
        std::filesystem::path folder = base && *base == '/' ? base : std::string(home ? home : "") + "/.cache";
        size_t key = std::hash<std::string>()(world + "\n" + process);
        m_path = folder / "fieldkit" / "gazebo" / (std::to_string(key) + ".json");
    }

    // The restoration that a killed run has left; empty if there is none.
    Restoration Read() const
    {
        Restoration restoration;
        std::ifstream stream(m_path);
        if (!stream)
        {
            return restoration;
        }
        try
        {
            Json json = Json::parse(stream);
            json.at("created").get_to(restoration.created);
            for (const Json& model : json.at("initial"))
            {
                const Json& position = model.at("position");
                restoration.initial.push_back({model.at("name"), model.at("sdf"), model.at("file"),
                                               {position.at(0), position.at(1), position.at(2)}, model.at("yaw")});
            }
        }
        catch (const Json::exception& error)
        {
            throw Refusal("the list of models " + m_path.string() + " is damaged (restart Gazebo, and delete it): " +
                          error.what());
        }
        return restoration;
    }

    // Write the restoration before the run changes the models.
    void Write(const Restoration& restoration) const
    {
        Json initial = Json::array();
        for (const InitialModel& model : restoration.initial)
        {
            const Vector& position = model.position;
            initial.push_back({{"name", model.name}, {"sdf", model.sdf}, {"file", model.file}, {"yaw", model.yaw},
                               {"position", {position.x, position.y, position.z}}});
        }
        std::error_code error;
        std::filesystem::create_directories(m_path.parent_path(), error);
        std::filesystem::path new_path = m_path;
        new_path += ".new";
        std::ofstream stream(new_path);
        stream << Json{{"created", restoration.created}, {"initial", initial}};
        stream.close();
        if (!stream || std::rename(new_path.c_str(), m_path.c_str()) != 0)
        {
            throw Refusal("the list of models " + m_path.string() + " cannot be written: " + std::strerror(errno));
        }
    }

    // Delete the file, after the models have been restored.
    void Delete() const
    {
        std::error_code error;
        std::filesystem::remove(m_path, error);
        if (error)
        {
            throw Refusal("the list of models " + m_path.string() + " cannot be deleted: " + error.message());
        }
    }

  private:
    std::filesystem::path m_path;
};

} // namespace fieldkit

#endif
