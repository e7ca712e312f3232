// Lists the splats of every tile, front to back.
//
// All splats of all views have been sorted by depth. `emit` writes the tiles of each splat in this
// order, a stable sort by tile (torch's radix sort) brings them together, and `arrange` finds where
// each tile's entries start. Tiles of view v have the numbers v * tiles + row * columns + column; the
// number after the last stands for room that is not used, and sorts behind all others. Where numbers
// fit into two bytes, they are stored so: the sort makes a pass for each byte.
#include "common.cuh"
#include "tiles.cuh"

// One thread per splat, in order of depth; ends is the running sum of counts in this order.
//
// Entries beyond `room` are dropped: they are those of the farthest splats.
template <typename Tile>
__device__ __forceinline__ void emit_splat(
    int total, int n, int width, int height, const long long *order, const long long *ends,
    const int *counts, const float2 *means2d, const float4 *shapes, int room, Tile *tiles,
    int2 *entries
) {
    int k = blockIdx.x * blockDim.x + threadIdx.x;
    if (k >= total) return;
    int row = (int)order[k], count = counts[row];
    long long start = ends[k] - count;
    if (count == 0 || start >= room) return;
    int tiles_a_view = ((width + TILE - 1) / TILE) * ((height + TILE - 1) / TILE);
    walk_tiles<Tile>(
        means2d[row], shapes[row], width, height, row, row / n * tiles_a_view,
        (int)min((long long)count, room - start), tiles + start, entries + start
    );
}

extern "C" __global__ void __launch_bounds__(256) emit_short(
    int total, int n, int width, int height, const long long *order, const long long *ends,
    const int *counts, const float2 *means2d, const float4 *shapes, int room, short *tiles,
    int2 *entries
) {
    emit_splat(total, n, width, height, order, ends, counts, means2d, shapes, room, tiles, entries);
}

extern "C" __global__ void __launch_bounds__(256) emit_int(
    int total, int n, int width, int height, const long long *order, const long long *ends,
    const int *counts, const float2 *means2d, const float4 *shapes, int room, int *tiles,
    int2 *entries
) {
    emit_splat(total, n, width, height, order, ends, counts, means2d, shapes, room, tiles, entries);
}

// One thread per place: entries follow their tiles into sorted order, and starts[t] becomes the first
// place whose tile is t or a later one, for t from 0 to `tile_count`.
template <typename Tile>
__device__ __forceinline__ void arrange_place(
    int room, int tile_count, const Tile *tiles, const long long *from, const int2 *entries,
    int2 *sorted, int *starts
) {
    int k = blockIdx.x * blockDim.x + threadIdx.x;
    if (k >= room) return;
    int tile = tiles[k], before = k > 0 ? tiles[k - 1] : -1;
    for (int t = before + 1; t <= tile; t++) starts[t] = k;
    if (k == room - 1)
        for (int t = tile + 1; t <= tile_count; t++) starts[t] = room;
    if (tile < tile_count) sorted[k] = entries[from[k]];
}

extern "C" __global__ void __launch_bounds__(256) arrange_short(
    int room, int tile_count, const short *tiles, const long long *from, const int2 *entries,
    int2 *sorted, int *starts
) {
    arrange_place(room, tile_count, tiles, from, entries, sorted, starts);
}

extern "C" __global__ void __launch_bounds__(256) arrange_int(
    int room, int tile_count, const int *tiles, const long long *from, const int2 *entries,
    int2 *sorted, int *starts
) {
    arrange_place(room, tile_count, tiles, from, entries, sorted, starts);
}
