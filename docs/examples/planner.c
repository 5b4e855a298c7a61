/* The inner loop of a planner in C, which docs/examples/planner.py calls: how far is a straight way free? */
#include <math.h>

#include "cairn_points.h"

/* Metres from one point to another until the first voxel that is not known to be free, in steps; all of the way where
 * all of it is free. -1 if the handle is closed. */
double free_way_m(cairn_state state, cairn_map map, const double from_m[3], const double to_m[3], double step_m) {
    const double way_m[3] = {to_m[0] - from_m[0], to_m[1] - from_m[1], to_m[2] - from_m[2]};
    const double length_m = sqrt(way_m[0] * way_m[0] + way_m[1] * way_m[1] + way_m[2] * way_m[2]);
    const long steps = (long)ceil(length_m / step_m);
    for (long n = 0; n <= steps; ++n) {
        const double part = steps ? (double)n / (double)steps : 0.0;
        const int32_t found =
            state(map, from_m[0] + part * way_m[0], from_m[1] + part * way_m[1], from_m[2] + part * way_m[2]);
        if (found == CAIRN_CLOSED) return -1.0;
        if (found != CAIRN_FREE) return part * length_m;
    }
    return length_m;
}
