// Scans of a benchmark, as `octomap.write_scans` writes them: for each float32 origin[3], int32 n, float32 xyz[n][3].
#pragma once
#include <octomap/OcTree.h>

#include <cstdint>
#include <fstream>
#include <stdexcept>
#include <string>
#include <vector>

struct Scan {
    octomap::point3d origin;
    octomap::Pointcloud points;
};

template <typename T>
bool read_into(std::ifstream& file, T* values, std::size_t count) {
    return static_cast<bool>(file.read(reinterpret_cast<char*>(values), static_cast<std::streamsize>(count * sizeof(T))));
}

inline std::vector<Scan> read_scans(const std::string& path) {
    std::ifstream file(path, std::ios::binary);
    std::vector<Scan> scans;
    float origin[3];
    while (read_into(file, origin, 3)) {
        std::int32_t count = 0;
        if (!read_into(file, &count, 1)) throw std::runtime_error("a scan is cut off");
        std::vector<float> xyz(3 * static_cast<std::size_t>(count));
        if (!read_into(file, xyz.data(), xyz.size())) throw std::runtime_error("a scan is cut off");
        Scan scan{{origin[0], origin[1], origin[2]}, {}};
        scan.points.reserve(static_cast<std::size_t>(count));
        for (std::size_t n = 0; n < xyz.size(); n += 3) scan.points.push_back(xyz[n], xyz[n + 1], xyz[n + 2]);
        scans.push_back(scan);
    }
    return scans;
}
