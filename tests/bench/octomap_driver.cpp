// OctoMap on the scans of a benchmark: how long it takes, and how large its tree is.
//
//     octomap_driver SCANS RESOLUTION_M RANGE_MAX_M                 time, occupancy alone
//     octomap_driver SCANS RESOLUTION_M RANGE_MAX_M STATES          and the state of each known voxel, written to STATES
//     octomap_driver SCANS RESOLUTION_M RANGE_MAX_M COLOURS OUT     a ColorOcTree, written to OUT (.ot)
//
// SCANS: octomap_scans.hpp; COLOURS: float32 xyz[3], uint8 rgba[4] each;
// STATES: int32 xyz[3] of the voxel, counted from the origin, int32 1 for occupied and -1 for free.
// Prints the CPU seconds that inserting took, and the number of leaves.
#include <octomap/ColorOcTree.h>
#include <octomap/OcTree.h>

#include <cstdint>
#include <ctime>
#include <fstream>
#include <iostream>
#include <string>
#include <vector>

#include "octomap_scans.hpp"

struct Colour {
    float xyz[3];
    std::uint8_t rgba[4];
};

// The voxels of a scan once each (`discretize`), inner nodes brought up to date after all scans: the fastest way it has.
template <typename Tree>
void insert(Tree& tree, const std::vector<Scan>& scans, double range_max_m) {
    const std::clock_t start = std::clock();
    for (const Scan& scan : scans) tree.insertPointCloud(scan.points, scan.origin, range_max_m, true, true);
    tree.updateInnerOccupancy();
    tree.prune();
    std::cout << static_cast<double>(std::clock() - start) / CLOCKS_PER_SEC << ' ' << tree.getNumLeafNodes() << '\n';
}

void write_states(octomap::OcTree& tree, const std::string& path) {
    const int origin = 1 << (tree.getTreeDepth() - 1);
    tree.expand();
    std::ofstream file(path, std::ios::binary);
    for (auto leaf = tree.begin_leafs(); leaf != tree.end_leafs(); ++leaf) {
        const octomap::OcTreeKey key = leaf.getKey();
        const std::int32_t row[4] = {key[0] - origin, key[1] - origin, key[2] - origin, tree.isNodeOccupied(*leaf) ? 1 : -1};
        file.write(reinterpret_cast<const char*>(row), sizeof row);
    }
}

int main(int argc, char** argv) {
    if (argc < 4 || argc > 6) {
        std::cerr << "octomap_driver SCANS RESOLUTION_M RANGE_MAX_M [STATES | COLOURS OUT]\n";
        return 2;
    }
    const std::vector<Scan> scans = read_scans(argv[1]);
    const double resolution_m = std::stod(argv[2]), range_max_m = std::stod(argv[3]);
    if (argc < 6) {
        octomap::OcTree tree(resolution_m);
        insert(tree, scans, range_max_m);
        if (argc == 5) write_states(tree, argv[4]);
        return 0;
    }
    octomap::ColorOcTree tree(resolution_m);
    insert(tree, scans, range_max_m);
    std::ifstream file(argv[4], std::ios::binary);
    for (Colour colour; read_into(file, &colour, 1);) {
        octomap::ColorOcTreeNode* node = tree.search(colour.xyz[0], colour.xyz[1], colour.xyz[2]);
        if (node != nullptr) node->setColor(colour.rgba[0], colour.rgba[1], colour.rgba[2]);
    }
    tree.updateInnerOccupancy();
    return tree.write(argv[5]) ? 0 : 1;
}
