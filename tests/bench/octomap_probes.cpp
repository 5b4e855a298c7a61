// What OctoMap says of some places after each scan of a benchmark.
//
//     octomap_probes SCANS RESOLUTION_M RANGE_MAX_M PROBES STATES
//
// SCANS: octomap_scans.hpp; PROBES: float32 xyz[3] each; STATES: for each scan int8 of each probe, written: 1 occupied,
// 0 unknown, -1 free.
#include <octomap/OcTree.h>

#include <cstdint>
#include <fstream>
#include <iostream>
#include <string>
#include <vector>

#include "octomap_scans.hpp"

int main(int argc, char** argv) {
    if (argc != 6) {
        std::cerr << "octomap_probes SCANS RESOLUTION_M RANGE_MAX_M PROBES STATES\n";
        return 2;
    }
    std::vector<octomap::point3d> probes;
    std::ifstream places(argv[4], std::ios::binary);
    for (float xyz[3]; read_into(places, xyz, 3);) probes.emplace_back(xyz[0], xyz[1], xyz[2]);

    octomap::OcTree tree(std::stod(argv[2]));
    std::ofstream out(argv[5], std::ios::binary);
    for (const Scan& scan : read_scans(argv[1])) {
        tree.insertPointCloud(scan.points, scan.origin, std::stod(argv[3]), true, true);
        std::vector<std::int8_t> states;
        for (const octomap::point3d& probe : probes) {
            const octomap::OcTreeNode* node = tree.search(probe);
            states.push_back(static_cast<std::int8_t>(node == nullptr ? 0 : tree.isNodeOccupied(node) ? 1 : -1));
        }
        out.write(reinterpret_cast<const char*>(states.data()), static_cast<std::streamsize>(states.size()));
    }
    return 0;
}
