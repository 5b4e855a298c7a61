/* Our map asked point by point from C, as OctoMap is in octomap_queries.cpp: the fewest CPU seconds of some runs. */
#include <time.h>

#include "cairn_points.h"

double ask(cairn_state state, cairn_map map, const double *points_m, int64_t count, int8_t *states, int repeats) {
    double best = 1e300;
    for (; repeats > 0; --repeats) {
        const clock_t start = clock();
        for (int64_t n = 0; n < count; ++n)
            states[n] = (int8_t)state(map, points_m[3 * n], points_m[3 * n + 1], points_m[3 * n + 2]);
        const double taken = (double)(clock() - start) / CLOCKS_PER_SEC;
        best = taken < best ? taken : best;
    }
    return best;
}
