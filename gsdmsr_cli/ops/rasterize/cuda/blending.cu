// Blends the splats of every tile front to back (3DGS), and back again.
//
// A block of threads draws a tile of 16 x 16 pixels, each of its eight warps a block of 8 x 4 of them.
// Splats come in batches through shared memory; a warp picks from a batch those that touch its own
// pixels, which binning has noted in a bit per warp, and goes through no others. It stops when all of
// its pixels are finished.
//
// The backward pass walks front to back as well: it carries what is left of the pixel's colour, so
// that nothing per pixel and splat has to be stored. Gradients of a splat are summed over the lanes of
// a warp before one atomic addition per value, in an order that is not fixed: the last bits of sums
// may differ from one run to the next.
#include "common.cuh"

#define THREADS (TILE * TILE)
#define SUMS 16  // floats for the sums of a splat: one pair of memory sectors

// What is summed for each splat, with e = alpha dLoss/dalpha of a pixel at (x, y) from its centre: e,
// e x, e y, e x^2, e x y, e y^2; weight times the slopes of red, green, blue and depth; and e x and e y
// without the weight of the tile.
enum { E, EX, EY, EXX, EXY, EYY, RED, GREEN, BLUE, DEPTH, PLAIN_EX, PLAIN_EY, WEIGHTED = PLAIN_EX };

// Projected splats, and which of them each tile has.
struct Splats {
    const float2 *means2d;
    const float4 *shapes, *paints;
    const int *starts;
    const int2 *entries;
};

struct Batch {
    float2 centre[THREADS];
    float4 shape[THREADS], paint[THREADS];
    int splat[THREADS];
    unsigned blocks[THREADS];
};

// Where a thread's pixel lies.
struct Place {
    int tile, view, column, row, lane, warp;
    bool inside;
    size_t at;  // of the pixel in planes (views, height, width)
};

__device__ __forceinline__ Place place(int width, int height) {
    int columns = (width + TILE - 1) / TILE, rows = (height + TILE - 1) / TILE;
    Place p;
    p.tile = blockIdx.x;
    p.view = p.tile / (columns * rows);
    int own = p.tile % (columns * rows);
    p.lane = threadIdx.x % WARP, p.warp = threadIdx.x / WARP;
    p.column = own % columns * TILE + p.warp % 2 * BLOCK_WIDTH + p.lane % BLOCK_WIDTH;
    p.row = own / columns * TILE + p.warp / 2 * BLOCK_HEIGHT + p.lane / BLOCK_WIDTH;
    p.inside = p.column < width && p.row < height;
    p.at = ((size_t)p.view * height + p.row) * width + p.column;
    return p;
}

// What of a pixel is not covered yet, and the colour and depth blended so far.
struct Pixel {
    float uncovered;
    float4 paint;
};

// Fills the batch with entries from `base` on, and returns whether all pixels of the tile are finished.
__device__ __forceinline__ bool load(
    Batch &batch, const Splats &splats, int base, int end, bool finished
) {
    if (__syncthreads_and(finished)) return true;
    int own = base + threadIdx.x;
    if (own < end) {
        int2 entry = splats.entries[own];
        batch.splat[threadIdx.x] = entry.x;
        batch.blocks[threadIdx.x] = (unsigned)entry.y;
        batch.centre[threadIdx.x] = splats.means2d[entry.x];
        batch.shape[threadIdx.x] = splats.shapes[entry.x];
        batch.paint[threadIdx.x] = splats.paints[entry.x];
    }
    __syncthreads();
    return false;
}

// Which entries of the batch from `first` on, a bit for each of 32, touch pixels of this warp.
__device__ __forceinline__ unsigned touching(const Batch &batch, int first, int count, Place p) {
    int own = first + p.lane;
    return __ballot_sync(ALL_LANES, own < count && (batch.blocks[own] >> p.warp & 1u));
}

// A splat at a pixel: offsets from its centre, falloff (opacity times Gaussian), and whether it counts.
struct Touch {
    float x, y, falloff;
    bool counts;
};

__device__ __forceinline__ Touch touch(const Batch &batch, int k, Place p, float uncovered) {
    Touch t;
    float4 shape = batch.shape[k];
    t.x = p.column + 0.5f - batch.centre[k].x;
    t.y = p.row + 0.5f - batch.centre[k].y;
    float power = shape.w + t.x * (shape.x * t.x + shape.y * t.y) + shape.z * t.y * t.y;
    t.counts = power >= LOG2_ALPHA_MIN && uncovered >= TRANSMITTANCE_STOP;
    t.falloff = exp2f(power);
    return t;
}

template <bool WITH_DEPTH>
__device__ __forceinline__ Pixel draw(Batch &batch, const Splats &splats, Place p) {
    int start = splats.starts[p.tile], end = splats.starts[p.tile + 1];
    Pixel pixel = {p.inside ? 1.0f : 0.0f, make_float4(0.0f, 0.0f, 0.0f, 0.0f)};
    bool finished = false;
    for (int base = start; base < end; base += THREADS) {
        if (load(batch, splats, base, end, finished)) break;
        int count = min(THREADS, end - base);
        for (int first = 0; first < count && !finished; first += WARP) {
            unsigned hits = touching(batch, first, count, p);
            while (hits) {
                int k = first + __ffs(hits) - 1;
                hits &= hits - 1;
                Touch t = touch(batch, k, p, pixel.uncovered);
                if (!t.counts) continue;
                float4 paint = batch.paint[k];
                float weight = fminf(t.falloff, ALPHA_MAX) * pixel.uncovered;
                pixel.uncovered -= weight;
                pixel.paint.x += weight * paint.x, pixel.paint.y += weight * paint.y;
                pixel.paint.z += weight * paint.z;
                if (WITH_DEPTH) pixel.paint.w += weight * paint.w;
            }
            finished = __all_sync(ALL_LANES, pixel.uncovered < TRANSMITTANCE_STOP);
        }
    }
    return pixel;
}

// One exchange of `sum_of_own`: a lane gives away the half of its values that its partner goes on with.
template <int HALF>
__device__ __forceinline__ void exchange(float (&values)[SUMS], int lane) {
    bool upper = lane & (2 * HALF);
#pragma unroll
    for (int i = 0; i < HALF; i++) {
        float kept = upper ? values[i + HALF] : values[i];
        float given = upper ? values[i] : values[i + HALF];
        values[i] = kept + __shfl_xor_sync(ALL_LANES, given, 2 * HALF);
    }
}

// Adds up 16 values over a warp in 16 shuffles instead of 80; lane l gets the sum of value l / 2.
__device__ __forceinline__ float sum_of_own(float (&values)[SUMS], int lane) {
    exchange<8>(values, lane);
    exchange<4>(values, lane);
    exchange<2>(values, lane);
    exchange<1>(values, lane);
    return values[0] + __shfl_xor_sync(ALL_LANES, values[0], 1);
}

// Adds a tile's shares of the gradients of its splats to `sums`.
//
// slope is that of the loss by the pixel's red, green, blue and depth; left is slope times what has
// been drawn, less the slope of alpha times what is uncovered. tile_weight multiplies all sums but the
// plain ones, which are only wanted where `weighted`.
template <bool WITH_DEPTH>
__device__ __forceinline__ void differentiate(
    Batch &batch, const Splats &splats, Place p, float4 slope, float left, bool weighted,
    float tile_weight, float *sums
) {
    int start = splats.starts[p.tile], end = splats.starts[p.tile + 1];
    float uncovered = p.inside ? 1.0f : 0.0f;
    bool finished = false;
    int slot = p.lane / 2;
    bool adds = p.lane % 2 == 0 && slot < (weighted ? PLAIN_EY + 1 : WITH_DEPTH ? DEPTH + 1 : DEPTH);
    for (int base = start; base < end; base += THREADS) {
        if (load(batch, splats, base, end, finished)) break;
        int count = min(THREADS, end - base);
        for (int first = 0; first < count && !finished; first += WARP) {
            unsigned hits = touching(batch, first, count, p);
            while (hits) {
                int k = first + __ffs(hits) - 1;
                hits &= hits - 1;
                Touch t = touch(batch, k, p, uncovered);
                if (!__any_sync(ALL_LANES, t.counts)) continue;
                float values[SUMS];
#pragma unroll
                for (int i = 0; i < SUMS; i++) values[i] = 0.0f;
                if (t.counts) {
                    float4 paint = batch.paint[k];
                    float alpha = fminf(t.falloff, ALPHA_MAX), weight = alpha * uncovered;
                    float share = slope.x * paint.x + slope.y * paint.y + slope.z * paint.z;
                    if (WITH_DEPTH) share += slope.w * paint.w;
                    share *= weight;
                    left -= share;
                    uncovered -= weight;
                    // a saturated pixel passes nothing to shape and opacity
                    float e = t.falloff <= ALPHA_MAX
                        ? share - __fdividef(alpha * left, 1.0f - alpha) : 0.0f;
                    values[E] = e, values[EX] = e * t.x, values[EY] = e * t.y;
                    values[EXX] = e * t.x * t.x, values[EXY] = e * t.x * t.y;
                    values[EYY] = e * t.y * t.y;
                    values[RED] = weight * slope.x, values[GREEN] = weight * slope.y;
                    values[BLUE] = weight * slope.z;
                    if (WITH_DEPTH) values[DEPTH] = weight * slope.w;
                }
                float sum = sum_of_own(values, p.lane);
                if (weighted) {
                    int from = slot < WEIGHTED ? p.lane : 2 * (slot - PLAIN_EX + EX);
                    sum = __shfl_sync(ALL_LANES, sum, from % WARP);
                    if (slot < WEIGHTED) sum *= tile_weight;
                }
                if (adds) atomicAdd(sums + (size_t)SUMS * batch.splat[k] + slot, sum);
            }
            finished = __all_sync(ALL_LANES, uncovered < TRANSMITTANCE_STOP);
        }
    }
}

__device__ __forceinline__ float3 over(const Pixel &pixel, const float *background) {
    return make_float3(
        pixel.paint.x + pixel.uncovered * background[0],
        pixel.paint.y + pixel.uncovered * background[1],
        pixel.paint.z + pixel.uncovered * background[2]
    );
}

// Planes (views, 3, height, width) of a pixel's red; green and blue lie one plane each behind it.
__device__ __forceinline__ size_t red_at(Place p, int width, int height) {
    return p.at + (size_t)2 * p.view * height * width;
}

// rgb is (views, 3, height, width), alpha and depth are (views, height, width).
template <bool WITH_DEPTH>
__device__ __forceinline__ void blend_tile(
    int width, int height, const Splats &splats, const float *background, float *rgb, float *alpha,
    float *depth
) {
    __shared__ Batch batch;
    Place p = place(width, height);
    Pixel pixel = draw<WITH_DEPTH>(batch, splats, p);
    if (!p.inside) return;
    float3 colour = over(pixel, background);
    size_t at = red_at(p, width, height), plane = (size_t)height * width;
    rgb[at] = colour.x, rgb[at + plane] = colour.y, rgb[at + 2 * plane] = colour.z;
    alpha[p.at] = 1.0f - pixel.uncovered;
    if (WITH_DEPTH) depth[p.at] = pixel.paint.w;
}

extern "C" __global__ void __launch_bounds__(THREADS) blend(
    int width, int height, Splats splats, const float *background, float *rgb, float *alpha
) {
    blend_tile<false>(width, height, splats, background, rgb, alpha, nullptr);
}

extern "C" __global__ void __launch_bounds__(THREADS) blend_with_depth(
    int width, int height, Splats splats, const float *background, float *rgb, float *alpha,
    float *depth
) {
    blend_tile<true>(width, height, splats, background, rgb, alpha, depth);
}

// Slopes have the layout of what was drawn; that of alpha may be absent, and then is 0.
template <bool WITH_DEPTH>
__device__ __forceinline__ void differentiate_tile(
    int width, int height, const Splats &splats, const float *rgb, const float *alpha,
    const float *depth, const float *d_rgb, const float *d_alpha, const float *d_depth, float *sums
) {
    __shared__ Batch batch;
    Place p = place(width, height);
    float4 slope = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
    float left = 0.0f;
    if (p.inside) {
        size_t at = red_at(p, width, height), plane = (size_t)height * width;
        slope.x = d_rgb[at], slope.y = d_rgb[at + plane], slope.z = d_rgb[at + 2 * plane];
        left = slope.x * rgb[at] + slope.y * rgb[at + plane] + slope.z * rgb[at + 2 * plane];
        if (d_alpha) left -= d_alpha[p.at] * (1.0f - alpha[p.at]);
        if (WITH_DEPTH) slope.w = d_depth[p.at], left += slope.w * depth[p.at];
    }
    differentiate<WITH_DEPTH>(batch, splats, p, slope, left, false, 1.0f, sums);
}

extern "C" __global__ void __launch_bounds__(THREADS) blend_backward(
    int width, int height, Splats splats, const float *rgb, const float *alpha, const float *d_rgb,
    const float *d_alpha, float *sums
) {
    differentiate_tile<false>(
        width, height, splats, rgb, alpha, nullptr, d_rgb, d_alpha, nullptr, sums
    );
}

extern "C" __global__ void __launch_bounds__(THREADS) blend_with_depth_backward(
    int width, int height, Splats splats, const float *rgb, const float *alpha, const float *depth,
    const float *d_rgb, const float *d_alpha, const float *d_depth, float *sums
) {
    differentiate_tile<true>(
        width, height, splats, rgb, alpha, depth, d_rgb, d_alpha, d_depth, sums
    );
}

// Draws a tile, compares it with the target and takes the gradients while it is at hand.
//
// weight is that of each distance in the loss, steep and half as in `distance_of`; tile_weights
// (views, tiles) are further factors on the loss of each tile, of which those of weight 0 are not
// drawn, or null for 1 everywhere. errors (views, tiles) get the sums of the distances without
// either weight.
extern "C" __global__ void __launch_bounds__(THREADS) blend_and_compare(
    int width, int height, Splats splats, const float *background,
    const __grid_constant__ Targets targets, float weight, float steep, float half,
    const float *tile_weights, double *errors, float *sums
) {
    __shared__ Batch batch;
    __shared__ float distances[THREADS / WARP];
    Place p = place(width, height);
    float tile_weight = tile_weights ? tile_weights[p.tile] : 1.0f;
    if (tile_weight == 0.0f) {
        if (threadIdx.x == 0) errors[p.tile] = 0.0;
        return;
    }
    Pixel pixel = draw<false>(batch, splats, p);
    float4 slope = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
    float left = 0.0f, distance = 0.0f;
    if (p.inside) {
        float3 drawn = over(pixel, background);
        size_t at = (size_t)p.row * width + p.column, plane = (size_t)height * width;
        const unsigned char *target = targets.of_view[p.view];
        float red = drawn.x - target[at] * (1.0f / 255.0f);
        float green = drawn.y - target[at + plane] * (1.0f / 255.0f);
        float blue = drawn.z - target[at + 2 * plane] * (1.0f / 255.0f);
        distance = distance_of(red, steep, half) + distance_of(green, steep, half)
            + distance_of(blue, steep, half);
        slope.x = slope_of_distance(red, weight, steep);
        slope.y = slope_of_distance(green, weight, steep);
        slope.z = slope_of_distance(blue, weight, steep);
        left = slope.x * drawn.x + slope.y * drawn.y + slope.z * drawn.z;
    }
    distance = warp_sum(distance);
    if (p.lane == 0) distances[p.warp] = distance;
    __syncthreads();
    if (threadIdx.x == 0) {
        double total = 0.0;
        for (int i = 0; i < THREADS / WARP; i++) total += distances[i];
        errors[p.tile] = total;
    }
    differentiate<false>(
        batch, splats, p, slope, left, tile_weights != nullptr, tile_weight, sums
    );
}

// One thread per row: turns its sums into gradients in the layout of `project`.
//
// on_screen gets what d_means2d would be if all tiles that are drawn had the weight 1; it may be null.
extern "C" __global__ void __launch_bounds__(256) gather(
    int rows, const float4 *shapes, const float *sums, float2 *d_means2d, float4 *d_shapes,
    float4 *d_paints, float2 *on_screen
) {
    int row = blockIdx.x * blockDim.x + threadIdx.x;
    if (row >= rows) return;
    const float *own = sums + (size_t)SUMS * row;
    float4 shape = shapes[row];
    d_means2d[row] = make_float2(
        -LN2 * (2 * shape.x * own[EX] + shape.y * own[EY]),
        -LN2 * (shape.y * own[EX] + 2 * shape.z * own[EY])
    );
    if (on_screen)
        on_screen[row] = make_float2(
            -LN2 * (2 * shape.x * own[PLAIN_EX] + shape.y * own[PLAIN_EY]),
            -LN2 * (shape.y * own[PLAIN_EX] + 2 * shape.z * own[PLAIN_EY])
        );
    d_shapes[row] = make_float4(LN2 * own[EXX], LN2 * own[EXY], LN2 * own[EYY], LN2 * own[E]);
    d_paints[row] = make_float4(own[RED], own[GREEN], own[BLUE], own[DEPTH]);
}
