// The radio channel as in sim_backends/radio/: mean path loss, obstacles, shadowing and fading, with the same random
// draws.

#ifndef FIELDKIT_CHANNEL_H
#define FIELDKIT_CHANNEL_H

#include "keyed_random.h"
#include "obstacles.h"

#include <cmath>
#include <complex>
#include <limits>
#include <memory>
#include <string>
#include <vector>

namespace fieldkit
{

class Channel
{
  public:
    // `radio` and `world` are sections of the configuration; `names` are the names of the stations by index.
    Channel(uint64_t seed, const Json& radio, const Json& world, std::vector<std::string> names)
        : m_seed(seed),
          m_names(std::move(names)),
          m_obstacles(world),
          m_propagation(radio.at("propagation")),
          m_exponent(Number(radio.at("exponent"))),
          m_shadowingDb(Number(radio.at("shadowing_db"))),
          m_fades(radio.at("fading")),
          m_k(std::pow(10, Number(radio.at("k_db")) / 10)),
          m_stir(Number(radio.at("stir_m_s"))),
          m_links(m_names.size() * m_names.size())
    {
        // A fading gain is used for 2 % of an echo's period, as in WorldChannel for stations at rest; a move of an end
        // also gives a new gain.
        m_slotNs = std::llround(0.02 * kSpeedOfLight / kFrequencyHz / std::max(m_stir, 1e-6) * 1e9);
        if (m_shadowingDb > 0)
        {
            DrawWaves(Number(radio.at("decorrelation")));
        }
    }

    // The loss between two stations in dB; infinity if the link is cut.
    double LossDb(int64_t now_ns, size_t a, const Point& at_a, size_t b, const Point& at_b)
    {
        // The first end of a link is the one whose name sorts first.
        bool swapped = m_names[b] < m_names[a];
        Link& link = m_links[swapped ? b * m_names.size() + a : a * m_names.size() + b];
        if (link.cuts > 0)
        {
            return std::numeric_limits<double>::infinity();
        }
        const Point& start = swapped ? at_b : at_a;
        const Point& end = swapped ? at_a : at_b;
        if (!link.is_computed || link.start != start || link.end != end)
        {
            Compute(link, start, end);
        }
        if (!m_fades)
        {
            return link.mean_db;
        }
        // The quotient is rounded down, also before time 0.
        int64_t slot = now_ns >= 0 ? now_ns / m_slotNs : -((-now_ns + m_slotNs - 1) / m_slotNs);
        if (!link.has_gain || link.slot != slot)
        {
            link.slot = slot;
            link.gain_db = 10 * std::log10(Gain(link, swapped ? b : a, swapped ? a : b));
            link.has_gain = true;
        }
        return link.mean_db - link.gain_db;
    }

    // The loss without fading, at the positions in the last call of LossDb for this link.
    double MeanLossDb(size_t a, size_t b) const
    {
        bool swapped = m_names[b] < m_names[a];
        const Link& link = m_links[swapped ? b * m_names.size() + a : a * m_names.size() + b];
        return link.cuts > 0 ? std::numeric_limits<double>::infinity() : link.mean_db;
    }

    // The mean loss in dB between two positions.
    double MeanLossDb(const Point& start, const Point& end) const
    {
        return OpenDb(start, end) + m_obstacles.LossDb(start, end);
    }

    // Add `change` to the number of reasons why two stations cannot receive each other.
    void Cut(size_t a, size_t b, int change)
    {
        m_links[a * m_names.size() + b].cuts += change;
        m_links[b * m_names.size() + a].cuts += change;
    }

  private:
    static constexpr int kEchoes = 12; // multipath components of each link
    static constexpr int kWaves = 256; // plane waves whose sum is the shadowing field

    // A multipath component of a link.
    struct Echo
    {
        double directions[4]; // east and north components at the first end, then at the second end
        double stir;          // rate at which moving scatterers lengthen its path, in m/s
        double phase;         // at time 0 with both ends at the origin
    };

    struct Link
    {
        Point start, end;
        bool is_computed = false;
        bool has_gain = false;
        int cuts = 0;       // reasons why the stations cannot receive each other
        double mean_db = 0; // loss without fading
        double k = 0;       // Rician K-factor, as a ratio of powers
        int64_t slot = 0;   // time slot of the gain
        double gain_db = 0;
        std::vector<Echo> echoes;
    };

    void Compute(Link& link, const Point& start, const Point& end)
    {
        double obstacles_db = m_obstacles.LossDb(start, end);
        link.start = start;
        link.end = end;
        link.mean_db = OpenDb(start, end) + obstacles_db;
        link.k = obstacles_db == 0 ? m_k : 0;
        link.is_computed = true;
        link.has_gain = false;
    }

    // The mean loss in dB without obstacles.
    double OpenDb(const Point& start, const Point& end) const
    {
        double length_m = Length(start, end);
        double loss_db = 0;
        if (m_propagation == "log-distance")
        {
            loss_db = 10 * m_exponent * std::log10(length_m) + Friis(1);
        }
        else if (m_propagation == "free-space")
        {
            loss_db = Friis(length_m);
        }
        else
        {
            loss_db = TwoRay(start, end, length_m);
        }
        return m_shadowingDb > 0 ? loss_db + m_shadowingDb * (Field(start) + Field(end)) / std::sqrt(2) : loss_db;
    }

    static double Length(const Point& start, const Point& end)
    {
        return std::max(std::hypot(end[0] - start[0], end[1] - start[1], end[2] - start[2]), 1.0);
    }

    static double Friis(double length_m)
    {
        return 20 * std::log10(4 * M_PI * length_m * kFrequencyHz / kSpeedOfLight);
    }

    static double TwoRay(const Point& start, const Point& end, double direct_m)
    {
        double reflected_m = Length(start, {end[0], end[1], -end[2]});
        double sine = std::min((start[2] + end[2]) / reflected_m, 1.0);
        double phase = 2 * M_PI * kFrequencyHz / kSpeedOfLight * (reflected_m - direct_m);
        auto permittivity = kGround.Permittivity();
        auto root = std::sqrt(permittivity - (1 - sine * sine));
        auto reflection = (permittivity * sine - root) / (permittivity * sine + root);
        auto ratio = 1.0 + reflection * direct_m / reflected_m * std::exp(std::complex<double>(0, -phase));
        return Friis(direct_m) - 20 * std::log10(std::max(std::abs(ratio), 0.01));
    }

    // Draw the plane waves whose sum is the shadowing field; see `Shadowing` in sim_backends/radio/propagation/fading.py.
    void DrawWaves(double decorrelation_m)
    {
        auto draws = RandomStream(m_seed, {"shadowing"}).First(3 * kWaves);
        for (int wave = 0; wave < kWaves; wave++)
        {
            double complement = 1 - draws[wave];
            double number = std::sqrt(1 / (complement * complement) - 1) / decorrelation_m;
            double angle = 2 * M_PI * draws[kWaves + wave];
            m_waves.push_back({number * std::cos(angle), number * std::sin(angle), 2 * M_PI * draws[2 * kWaves + wave]});
        }
    }

    // The shadowing field at a point; its mean is 0, and its variance is 1.
    double Field(const Point& point) const
    {
        double sum = 0;
        for (const auto& wave : m_waves)
        {
            sum += std::cos(point[0] * wave[0] + point[1] * wave[1] + wave[2]);
        }
        return sum * std::sqrt(2.0 / kWaves);
    }

    void DrawEchoes(Link& link, size_t first, size_t second) const
    {
        auto draws = RandomStream(m_seed, {m_names[first], m_names[second], "fading"}).First(4 * kEchoes);
        auto angle = [](int sector, double within) { return 2 * M_PI / kEchoes * (sector % kEchoes + within); };
        for (int n = 0; n < kEchoes; n++)
        {
            double departure = angle(n, draws[n]);
            double arrival = angle(5 * n, draws[kEchoes + n]);
            link.echoes.push_back({{std::cos(departure), std::sin(departure), std::cos(arrival), std::sin(arrival)},
                                   m_stir * std::cos(angle(7 * n, draws[2 * kEchoes + n])),
                                   2 * M_PI * draws[3 * kEchoes + n]});
        }
    }

    // The power gain of the link's fading in its current slot.
    double Gain(Link& link, size_t first, size_t second) const
    {
        if (link.echoes.empty())
        {
            DrawEchoes(link, first, second);
        }
        double rad_per_m = 2 * M_PI * kFrequencyHz / kSpeedOfLight;
        double after_s = static_cast<double>(link.slot * m_slotNs) * 1e-9;
        std::complex<double> sum = 0;
        for (const Echo& echo : link.echoes)
        {
            double path_m = link.start[0] * echo.directions[0] + link.start[1] * echo.directions[1] +
                            link.end[0] * echo.directions[2] + link.end[1] * echo.directions[3];
            sum += std::polar(1.0, rad_per_m * path_m + echo.phase + after_s * rad_per_m * echo.stir);
        }
        double distance_m = std::hypot(link.end[0] - link.start[0], link.end[1] - link.start[1],
                                       link.end[2] - link.start[2]);
        auto steady = std::polar(std::sqrt(link.k / (link.k + 1)), rad_per_m * distance_m);
        return std::max(std::norm(steady + sum / std::sqrt(kEchoes * (link.k + 1))), 1e-30);
    }

    uint64_t m_seed;
    std::vector<std::string> m_names;
    Obstacles m_obstacles;
    std::string m_propagation;
    double m_exponent;
    double m_shadowingDb;
    bool m_fades;
    double m_k;           // Rician K-factor of links in line of sight, as a ratio of powers
    double m_stir;        // speed of the moving scatterers, in m/s
    int64_t m_slotNs = 1; // time for which a fading gain is used
    std::vector<Link> m_links;
    std::vector<std::array<double, 3>> m_waves; // wave numbers east and north, phase
};

} // namespace fieldkit

#endif
