// Which tiles, and which 8 x 4 blocks of pixels inside them, an ellipse on the screen touches.
#pragma once
#include "common.cuh"

#define ROUNDING 2e-3f  // widening of an ellipse [px] that covers float32 rounding of its rim

// The first and last pixel of [0, size) whose centre lies in [low, high]; last < first if none does.
// Positions are clamped before they become integers: splats can be astronomically far off the screen.
__device__ __forceinline__ int2 pixel_range(float low, float high, int size) {
    low = ceilf(fminf(fmaxf(low - 0.5f - ROUNDING, 0.0f), (float)size));
    high = floorf(fminf(fmaxf(high - 0.5f + ROUNDING, -1.0f), (float)(size - 1)));
    return make_int2((int)low, (int)high);
}

// The region of the screen where a splat's alpha reaches ALPHA_MIN: the points at offsets (x, y) from
// its centre with p x^2 + 2 q x y + r y^2 <= reach, which extends to |x| = half_x and |y| = half_y.
struct Ellipse {
    float x, y, q, r, det, reach, half_x, half_y, x_of_lowest;
};

// shape holds A, B, C, L of alpha = 2^(L + A x^2 + B x y + C y^2).
__device__ __forceinline__ Ellipse ellipse_of(float2 centre, float4 shape) {
    Ellipse e;
    float p = -shape.x;
    e.x = centre.x, e.y = centre.y;
    e.q = -0.5f * shape.y, e.r = -shape.z;
    e.reach = fmaxf(shape.w - LOG2_ALPHA_MIN, 0.0f);
    e.det = fmaxf(p * e.r - e.q * e.q, 1e-30f);
    e.half_x = sqrtf(e.reach * e.r / e.det);
    e.half_y = sqrtf(e.reach * p / e.det);
    e.x_of_lowest = -e.q / p * e.half_y;
    return e;
}

// The rows of pixels that the ellipse touches in the columns whose centres lie in [left, right] [px].
__device__ __forceinline__ int2 rows_between(const Ellipse &e, float left, float right, int height) {
    float low = fmaxf(left - e.x - ROUNDING, -e.half_x);
    float high = fminf(right - e.x + ROUNDING, e.half_x);
    if (low > high) return make_int2(0, -1);
    float x_top = fminf(fmaxf(-e.x_of_lowest, low), high);
    float x_bottom = fminf(fmaxf(e.x_of_lowest, low), high);
    float top = (-e.q * x_top - sqrtf(fmaxf(e.reach * e.r - e.det * x_top * x_top, 0.0f))) / e.r;
    float bottom =
        (-e.q * x_bottom + sqrtf(fmaxf(e.reach * e.r - e.det * x_bottom * x_bottom, 0.0f))) / e.r;
    return pixel_range(e.y + top, e.y + bottom, height);
}

// Bits of the blocks of one column of blocks of a tile whose first row is `top`, for rows first..last.
__device__ __forceinline__ unsigned blocks_of_rows(int2 rows, int top) {
    unsigned bits = 0;
    int first = max(rows.x - top, 0) / BLOCK_HEIGHT;
    int last = min(rows.y - top, TILE - 1);
    for (int block = first; block * BLOCK_HEIGHT <= last; block++) bits |= 1u << (2 * block);
    return bits;
}

// Walks the tiles that a splat touches and returns how many they are. With `entries`, tile and
// (splat, bits of its blocks) of the first `room` of them are written. One function, never inlined,
// counts and writes, so that both find the same.
template <typename Tile>
__device__ __noinline__ int walk_tiles(
    float2 centre, float4 shape, int width, int height, int splat, int first_tile, int room,
    Tile *tiles, int2 *entries
) {
    Ellipse e = ellipse_of(centre, shape);
    int columns = (width + TILE - 1) / TILE;
    int2 across = pixel_range(e.x - e.half_x, e.x + e.half_x, width);
    if (across.y < across.x) return 0;
    int found = 0;
    for (int column = across.x / TILE; column <= across.y / TILE; column++) {
        float left = column * TILE + 0.5f;
        int2 one = rows_between(e, left, left + (BLOCK_WIDTH - 1), height);
        int2 two = rows_between(e, left + BLOCK_WIDTH, left + (TILE - 1), height);
        bool in_one = one.x <= one.y, in_two = two.x <= two.y;
        if (!in_one && !in_two) continue;
        int top = min(in_one ? one.x : two.x, in_two ? two.x : one.x) / TILE;
        int bottom = max(in_one ? one.y : two.y, in_two ? two.y : one.y) / TILE;
        for (int row = top; row <= bottom; row++) {
            unsigned blocks = in_one ? blocks_of_rows(one, row * TILE) : 0;
            if (in_two) blocks |= blocks_of_rows(two, row * TILE) << 1;
            if (!blocks) continue;
            if (entries && found < room) {
                tiles[found] = (Tile)(first_tile + row * columns + column);
                entries[found] = make_int2(splat, (int)blocks);
            }
            found++;
        }
    }
    return found;
}
