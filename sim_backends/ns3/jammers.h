// Jammers of a scenario: noise in the whole channel. YansWifiChannel carries frames only, so the noise is added to each
// radio as a signal that is not a frame. ns-3's interference model adds it to the interference of frames, and ns-3's
// energy detection (-62 dBm) includes it in carrier sense.

#ifndef FIELDKIT_JAMMERS_H
#define FIELDKIT_JAMMERS_H

#include "stations.h"

#include "ns3/interference-helper.h"
#include "ns3/wifi-phy.h"

namespace fieldkit
{

// Gives access to protected members of ns-3's WifiPhy: C++ allows pointers to them only in a subclass.
class RadioAccess : public WifiPhy
{
  public:
    static void AddNoise(WifiPhy& phy, Time duration, double power_w)
    {
        RxPowerWattPerChannelBand powers;
        powers[phy.GetBand(kWidthMhz)] = RxPowerWattPerChannelBand::mapped_type(power_w);
        AddSignal(*(phy.*&RadioAccess::m_interference), duration, powers, phy, 0);
        (phy.*&RadioAccess::SwitchMaybeToCcaBusy)(nullptr);
    }

  private:
    static constexpr uint16_t kWidthMhz = 20;

    // Versions of ns-3 after 3.37 need the range of frequencies. The argument 0 selects this overload (int) if it
    // compiles, otherwise the next one (long).
    template <typename Helper, typename Powers, typename Phy>
    static auto AddSignal(Helper& helper, Time duration, Powers& powers, const Phy& phy, int)
        -> decltype(helper.AddForeignSignal(duration, powers, phy.GetCurrentFrequencyRange()))
    {
        helper.AddForeignSignal(duration, powers, phy.GetCurrentFrequencyRange());
    }

    template <typename Helper, typename Powers, typename Phy>
    static auto AddSignal(Helper& helper, Time duration, Powers& powers, const Phy&, long)
        -> decltype(helper.AddForeignSignal(duration, powers))
    {
        helper.AddForeignSignal(duration, powers);
    }
};

class Jammers
{
  public:
    Jammers(const std::vector<Station>& stations, const Channel& channel, double noise_dbm)
        : m_stations(stations),
          m_channel(channel),
          m_negligible_dbm(noise_dbm - 40) // this power would increase the noise by 0.0004 dB
    {
    }

    // Emit noise between two times; `locate` sets the position of the jammer, and returns false if the jammer is absent.
    void Add(double power_dbm, Time from, Time until, std::function<bool(Point&)> locate)
    {
        Simulator::Schedule(from - Simulator::Now(), [this, power_dbm, until, locate] { Emit(power_dbm, until, locate); });
    }

  private:
    // The power is constant for this interval, because a robot hardly moves in it.
    static constexpr int64_t kSliceNs = 1'000'000;

    void Emit(double power_dbm, Time until, const std::function<bool(Point&)>& locate)
    {
        Time slice = std::min(NanoSeconds(kSliceNs), until - Simulator::Now());
        Point at;
        if (slice.IsZero() || slice.IsNegative())
        {
            return;
        }
        if (locate(at))
        {
            for (const Station& station : m_stations)
            {
                Vector here = station.mobility->GetPosition();
                double received_dbm = power_dbm - m_channel.MeanLossDb(at, {here.x, here.y, here.z});
                if (received_dbm > m_negligible_dbm)
                {
                    auto device = DynamicCast<WifiNetDevice>(station.device);
                    RadioAccess::AddNoise(*device->GetPhy(), slice, std::pow(10, received_dbm / 10 - 3));
                }
            }
        }
        Simulator::Schedule(slice, [this, power_dbm, until, locate] { Emit(power_dbm, until, locate); });
    }

    const std::vector<Station>& m_stations;
    const Channel& m_channel;
    double m_negligible_dbm;
};

} // namespace fieldkit

#endif
