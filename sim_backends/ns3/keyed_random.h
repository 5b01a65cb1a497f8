// The keyed random draws of sim_backends/radio/core/random_streams.py: Philox-4x64 with a key hashed from a name.

#ifndef FIELDKIT_KEYED_RANDOM_H
#define FIELDKIT_KEYED_RANDOM_H

#include <array>
#include <cstdint>
#include <cstring>
#include <nlohmann/json.hpp>
#include <string>
#include <vector>

namespace fieldkit
{

// BLAKE2b without a key (RFC 7693), with a digest of 128 bits. Short names of variables are those of the RFC.
class Blake2b
{
  public:
    static std::array<uint64_t, 2> Digest128(const std::string& text)
    {
        Blake2b hash;
        size_t at = 0;
        while (text.size() - at > kBlockBytes)
        {
            hash.Compress(text.data() + at, kBlockBytes, at + kBlockBytes, false);
            at += kBlockBytes;
        }
        hash.Compress(text.data() + at, text.size() - at, text.size(), true);
        return {hash.m_state[0], hash.m_state[1]};
    }

  private:
    static constexpr size_t kBlockBytes = 128;
    static constexpr uint64_t kDigestBytes = 16;
    static constexpr std::array<uint64_t, 8> kInitial = {
        0x6a09e667f3bcc908, 0xbb67ae8584caa73b, 0x3c6ef372fe94f82b, 0xa54ff53a5f1d36f1,
        0x510e527fade682d1, 0x9b05688c2b3e6c1f, 0x1f83d9abfb41bd6b, 0x5be0cd19137e2179,
    };
    static constexpr uint8_t kSigma[10][16] = {
        {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15},
        {14, 10, 4, 8, 9, 15, 13, 6, 1, 12, 0, 2, 11, 7, 5, 3},
        {11, 8, 12, 0, 5, 2, 15, 13, 10, 14, 3, 6, 7, 1, 9, 4},
        {7, 9, 3, 1, 13, 12, 11, 14, 2, 6, 5, 10, 4, 0, 15, 8},
        {9, 0, 5, 7, 2, 4, 10, 15, 14, 1, 11, 12, 6, 8, 3, 13},
        {2, 12, 6, 10, 0, 11, 8, 3, 4, 13, 7, 5, 15, 14, 1, 9},
        {12, 5, 1, 15, 14, 13, 4, 10, 0, 7, 6, 3, 9, 2, 8, 11},
        {13, 11, 7, 14, 12, 1, 3, 9, 5, 0, 15, 4, 8, 6, 2, 10},
        {6, 15, 14, 9, 11, 3, 0, 8, 12, 2, 13, 7, 1, 4, 10, 5},
        {10, 2, 8, 4, 7, 6, 1, 5, 15, 11, 9, 14, 3, 12, 13, 0},
    };

    Blake2b()
        : m_state(kInitial)
    {
        m_state[0] ^= 0x01010000 ^ kDigestBytes; // parameters: fanout 1, depth 1, no key, size of the digest
    }

    static uint64_t Rotate(uint64_t value, int bits)
    {
        return value >> bits | value << (64 - bits);
    }

    void Compress(const char* data, size_t size, uint64_t total, bool last)
    {
        char block[kBlockBytes] = {};
        std::memcpy(block, data, size);
        uint64_t m[16];
        for (int word = 0; word < 16; word++)
        {
            m[word] = 0;
            for (int byte = 7; byte >= 0; byte--)
            {
                m[word] = m[word] << 8 | static_cast<uint8_t>(block[8 * word + byte]);
            }
        }
        uint64_t v[16];
        for (int i = 0; i < 8; i++)
        {
            v[i] = m_state[i];
            v[i + 8] = kInitial[i];
        }
        v[12] ^= total;
        v[14] ^= last ? ~uint64_t{0} : 0;
        auto mix = [&v](int a, int b, int c, int d, uint64_t x, uint64_t y) {
            v[a] += v[b] + x;
            v[d] = Rotate(v[d] ^ v[a], 32);
            v[c] += v[d];
            v[b] = Rotate(v[b] ^ v[c], 24);
            v[a] += v[b] + y;
            v[d] = Rotate(v[d] ^ v[a], 16);
            v[c] += v[d];
            v[b] = Rotate(v[b] ^ v[c], 63);
        };
        for (int round = 0; round < 12; round++)
        {
            const uint8_t* s = kSigma[round % 10];
            for (int i = 0; i < 4; i++)
            {
                mix(i, i + 4, i + 8, i + 12, m[s[2 * i]], m[s[2 * i + 1]]);
            }
            for (int i = 0; i < 4; i++)
            {
                mix(i, (i + 1) % 4 + 4, (i + 2) % 4 + 8, (i + 3) % 4 + 12, m[s[2 * i + 8]], m[s[2 * i + 9]]);
            }
        }
        for (int i = 0; i < 8; i++)
        {
            m_state[i] ^= v[i] ^ v[i + 8];
        }
    }

    std::array<uint64_t, 8> m_state;
};

// `RandomStream(seed, *name)`: uniform draws on [0, 1) by number.
class RandomStream
{
  public:
    RandomStream(uint64_t seed, const std::vector<std::string>& name)
    {
        // The text is equal to the result of Python's json.dumps.
        std::string text = "[" + std::to_string(seed);
        for (const auto& word : name)
        {
            text += ", " + nlohmann::json(word).dump(-1, ' ', true);
        }
        m_key = Blake2b::Digest128(text + "]");
    }

    double Draw(uint64_t number) const
    {
        return Uniform(Block(number / kBlockWords)[number % kBlockWords]);
    }

    // The draws for the numbers 0 to `count` - 1.
    std::vector<double> First(size_t count) const
    {
        std::vector<double> draws;
        for (uint64_t block = 0; draws.size() < count; block++)
        {
            for (uint64_t word : Block(block))
            {
                draws.push_back(Uniform(word));
            }
        }
        draws.resize(count);
        return draws;
    }

  private:
    static constexpr size_t kBlockWords = 4;

    static double Uniform(uint64_t word)
    {
        return static_cast<double>(word >> 11) * 0x1p-53;
    }

    // The words with the numbers 4 `number` to 4 `number` + 3: Philox-4x64 with 10 rounds.
    std::array<uint64_t, kBlockWords> Block(uint64_t number) const
    {
        // numpy increments the counter before it generates the first words.
        std::array<uint64_t, kBlockWords> counter = {number + 1, 0, 0, 0};
        uint64_t k0 = m_key[0];
        uint64_t k1 = m_key[1];
        for (int round = 0; round < 10; round++)
        {
            auto first = static_cast<unsigned __int128>(0xD2E7470EE14C6C93) * counter[0];
            auto second = static_cast<unsigned __int128>(0xCA5A826395121157) * counter[2];
            counter = {
                static_cast<uint64_t>(second >> 64) ^ counter[1] ^ k0,
                static_cast<uint64_t>(second),
                static_cast<uint64_t>(first >> 64) ^ counter[3] ^ k1,
                static_cast<uint64_t>(first),
            };
            k0 += 0x9E3779B97F4A7C15;
            k1 += 0xBB67AE8584CAA73B;
        }
        return counter;
    }

    std::array<uint64_t, 2> m_key;
};

} // namespace fieldkit

#endif
