/* Occupancy states of a cairn map at points, for planners in C and C++.
 *
 *     planner.plan(handle.state_address, handle.map)       Python: handle = cairn.PointHandle(snapshot)
 *
 *     if (state(map, x, y, z) == CAIRN_FREE) ...           C: cairn_state state, cairn_map map
 *
 * Points are metres in the map's frame. Answers are those of `snapshot.state_at`, bit for bit. Any thread may call, any
 * number at a time, with or without Python's GIL. After the handle was closed, or its Python object is gone, each call
 * with its number answers CAIRN_CLOSED; closing waits for calls that have begun. A number that no handle gave is as bad
 * as any wild pointer; only 0 is safe.
 */
#ifndef CAIRN_POINTS_H
#define CAIRN_POINTS_H

#include <stdint.h>

#define CAIRN_POINTS_VERSION 1 /* grows when the types below change; PointHandle.VERSION is the library's */

enum {
    CAIRN_UNKNOWN = 0,
    CAIRN_FREE = 1,
    CAIRN_OCCUPIED = 2,
    CAIRN_OUTSIDE = -1, /* not finite, or outside of the numbered space: some 5 000 km around the origin */
    CAIRN_CLOSED = -2   /* the handle is closed; nothing was looked up */
};

/* Number of an open handle. It is never given to a later one. */
typedef uint64_t cairn_map;

/* State of the voxel that holds a point; of layers, the finest layer's that knows it. */
typedef int32_t (*cairn_state)(cairn_map map, double x_m, double y_m, double z_m);

/* States of count points, x, y, z each, written to states; returns 0, or CAIRN_OUTSIDE if a point has that state, or
 * CAIRN_CLOSED, and then writes nothing. */
typedef int32_t (*cairn_states)(cairn_map map, const double *points_m, int64_t count, int8_t *states);

#endif
