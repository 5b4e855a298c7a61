// OctoMap asked what we are asked, on the same map: how long `search` and `castRay` take, and what they find.
//
//     octomap_queries VOXELS RESOLUTION_M POINTS RAYS RANGE_MAX_M REPEATS
//
// VOXELS: float32 xyz[3], log_odds each; POINTS: float32 xyz[3]; RAYS: float32 origin[3], direction[3].
// Prints the fewest CPU seconds that the points took, how many are known and occupied, then the fewest of the rays, and
// how many hit. Unknown voxels do not end a ray.
#include <octomap/OcTree.h>

#include <algorithm>
#include <cstdint>
#include <ctime>
#include <fstream>
#include <iostream>
#include <limits>
#include <string>
#include <vector>

std::vector<float> read_floats(const std::string& path) {
    std::ifstream file(path, std::ios::binary | std::ios::ate);
    std::vector<float> values(static_cast<std::size_t>(file.tellg()) / sizeof(float));
    file.seekg(0).read(reinterpret_cast<char*>(values.data()), static_cast<std::streamsize>(values.size() * sizeof(float)));
    return values;
}

double cpu_s() { return static_cast<double>(std::clock()) / CLOCKS_PER_SEC; }

int main(int argc, char** argv) {
    if (argc != 7) {
        std::cerr << "octomap_queries VOXELS RESOLUTION_M POINTS RAYS RANGE_MAX_M REPEATS\n";
        return 2;
    }
    octomap::OcTree tree(std::stod(argv[2]));
    const std::vector<float> voxels = read_floats(argv[1]);
    for (std::size_t n = 0; n < voxels.size(); n += 4)
        tree.setNodeValue(octomap::point3d(voxels[n], voxels[n + 1], voxels[n + 2]), voxels[n + 3], true);
    tree.updateInnerOccupancy();
    tree.prune();

    const std::vector<float> points = read_floats(argv[3]), rays = read_floats(argv[4]);
    const double range_max_m = std::stod(argv[5]);
    std::vector<float> log_odds(points.size() / 3);
    std::vector<octomap::point3d> ends(rays.size() / 6);
    double points_s = std::numeric_limits<double>::max(), rays_s = points_s;
    std::size_t known = 0, occupied = 0, hits = 0;
    for (int repeat = std::stoi(argv[6]); repeat > 0; --repeat) {
        known = occupied = hits = 0;
        double start = cpu_s();
        for (std::size_t n = 0; n < log_odds.size(); ++n) {
            const octomap::OcTreeNode* node = tree.search(points[3 * n], points[3 * n + 1], points[3 * n + 2]);
            log_odds[n] = node ? node->getLogOdds() : std::numeric_limits<float>::quiet_NaN();
        }
        points_s = std::min(points_s, cpu_s() - start);
        for (float value : log_odds) known += value == value, occupied += value > 0;

        start = cpu_s();
        for (std::size_t n = 0; n < ends.size(); ++n) {
            const float* ray = &rays[6 * n];
            const octomap::point3d origin(ray[0], ray[1], ray[2]), direction(ray[3], ray[4], ray[5]);
            hits += tree.castRay(origin, direction, ends[n], true, range_max_m);
        }
        rays_s = std::min(rays_s, cpu_s() - start);
    }
    std::cout << points_s << ' ' << known << ' ' << occupied << ' ' << rays_s << ' ' << hits << '\n';
}
