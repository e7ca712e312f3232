// Looks features up in HexPlane grids and scatters gradients back (Cao & Johnson 2023).
//
// A level holds three spatial planes (xy, xz, yz) and three temporal ones (x, y, z against time), in
// chunks of 16 channels: space is (3, chunks, R, R, 16) with a plane's second axis first, time is (3,
// chunks, T, R, 16). All points of a frame share one time, so the temporal planes collapse to three
// lines. The feature is the product of the six samples, positions clamped to the border. The same points may
// be looked up at several times: what they read of space, and add to its gradients, is then done once.
//
// 16 lanes, half a warp, do one point: a lane per channel of a chunk, so that a node is one access of
// 64 bytes, and so is the atomic addition to it.
//
// Whoever includes this says with NODE in which format nodes are read. Where that is a half of float32, an
// access is 32 bytes; what is trained, what is summed and the gradients are float32 all the same.
#pragma once
#include "common.cuh"
#include "number_formats.cuh"

#define CHANNELS 16
#define THREADS 256

struct Level {
    const float *space, *time;
    NODE *nodes;  // of the spatial planes: a copy, or themselves where they are read in float32
    NODE *lines;  // (moments, 3, chunks, R, 16), the temporal planes at each time
    float *d_space, *d_time, *d_lines;
    int size, times, chunks;  // nodes along a spatial axis and in time
};

struct Levels {
    int count, moments;
    int cubic;  // whether cubic B-splines lie between the nodes in time, not straight lines
    float moment[MOST_VIEWS];  // the times, in [-1, 1]
    float scale[3], shift[3];  // take positions to [-1, 1]
    Level level[MOST_LEVELS];
};

struct Cell {
    int lower;
    float upper_weight, inside;
};

// The lower node and the weight of the upper one for x in [-1, 1] on `size` nodes.
__device__ __forceinline__ Cell cell(float x, int size) {
    Cell c;
    float u = fminf(fmaxf((x + 1.0f) * 0.5f * (size - 1), 0.0f), (float)(size - 1));
    c.lower = min((int)u, size - 2);
    c.upper_weight = u - c.lower;
    c.inside = fabsf(x) <= 1.0f ? 1.0f : 0.0f;
    return c;
}

// The uniform cubic B-spline at x nodes from its middle.
__device__ __forceinline__ float bump(float x) {
    x = fabsf(x);
    float rest = fmaxf(2.0f - x, 0.0f);
    return x < 1.0f ? 2.0f / 3.0f + x * x * (0.5f * x - 1.0f) : rest * rest * rest / 6.0f;
}

// What a node in time counts at a place: on a curve the nodes before the first and after the last lie on a
// straight line with their two neighbours, so that it ends without curvature.
__device__ __forceinline__ float weight_of(const Cell &at, int node, int times, int cubic) {
    int away = node - at.lower;
    if (!cubic) return away == 0 ? 1.0f - at.upper_weight : away == 1 ? at.upper_weight : 0.0f;
    float before = bump(-1 - at.lower - at.upper_weight);
    float after = bump(times - at.lower - at.upper_weight), weight = bump(away - at.upper_weight);
    if (node == 0) weight += 2.0f * before;
    if (node == 1) weight -= before;
    if (node == times - 1) weight += 2.0f * after;
    if (node == times - 2) weight -= after;
    return weight;
}

// Writes the lines of all levels, and the nodes if they are a copy; one block along y per level.
extern "C" __global__ void __launch_bounds__(THREADS) collapse(
    const __grid_constant__ Levels levels
) {
    const Level &level = levels.level[blockIdx.y];
    int row = level.size * CHANNELS, k = blockIdx.x * THREADS + threadIdx.x;
    if (sizeof(NODE) < sizeof(float) && k < 3 * level.chunks * level.size * row)
        store(level.nodes + k, level.space[k]);
    int lines = 3 * level.chunks * row;
    if (k >= levels.moments * lines) return;
    Cell at = cell(levels.moment[k / lines], level.times);
    int line = k % lines / row;
    const float *first = level.time + (size_t)(line * level.times) * row + k % row;
    const float *low = first + (size_t)at.lower * row;
    float value = low[0] + (low[row] - low[0]) * at.upper_weight;
    if (levels.cubic) {
        value = 0.0f;
        for (int n = max(at.lower - 1, 0); n <= min(at.lower + 2, level.times - 1); n++)
            value += weight_of(at, n, level.times, 1) * first[(size_t)n * row];
    }
    store(level.lines + k, value);
}

// Writes the gradients of the temporal planes: of each time those of the lines at few nodes, 0 at others.
extern "C" __global__ void __launch_bounds__(THREADS) spread(
    const __grid_constant__ Levels levels
) {
    const Level &level = levels.level[blockIdx.y];
    int row = level.size * CHANNELS, k = blockIdx.x * THREADS + threadIdx.x;
    if (k >= 3 * level.chunks * level.times * row) return;
    const float *d_line = level.d_lines + k / (row * level.times) * row + k % row;
    float d = 0.0f;
    for (int m = 0; m < levels.moments; m++, d_line += 3 * level.chunks * row) {
        Cell at = cell(levels.moment[m], level.times);
        float weight = weight_of(at, k / row % level.times, level.times, levels.cubic);
        // not multiplied where the weight is 0: what is not finite must not spread
        if (weight != 0.0f) d += weight * *d_line;
    }
    level.d_time[k] = d;
}

// A sample of a plane or a line, its derivatives in cells, and where its lowest node is.
struct Sample {
    float value, by_first, by_second;
    int at;
};

__device__ __forceinline__ Sample bilinear(
    const NODE *plane, int size, int base, const Cell &first, const Cell &second, int lane
) {
    Sample s;
    int row = size * CHANNELS;
    s.at = base + second.lower * row + first.lower * CHANNELS + lane;
    float c00 = load(plane + s.at), c01 = load(plane + s.at + CHANNELS);
    float c10 = load(plane + s.at + row), c11 = load(plane + s.at + row + CHANNELS);
    float low = c00 + (c01 - c00) * first.upper_weight;
    s.by_second = c10 + (c11 - c10) * first.upper_weight - low;
    s.by_first = (c01 - c00) + ((c11 - c10) - (c01 - c00)) * second.upper_weight;
    s.value = low + s.by_second * second.upper_weight;
    return s;
}

__device__ __forceinline__ Sample linear(const NODE *line, int base, const Cell &c, int lane) {
    Sample s;
    s.at = base + c.lower * CHANNELS + lane;
    float low = load(line + s.at);
    s.by_first = load(line + s.at + CHANNELS) - low;
    s.by_second = 0.0f;
    s.value = low + s.by_first * c.upper_weight;
    return s;
}

// The samples of a chunk of a level: in space, and at one time.
struct InSpace {
    Sample xy, xz, yz;
};

struct InTime {
    Sample x, y, z;
};

struct Cells {
    Cell x, y, z;
};

__device__ __forceinline__ Cells cells_of(
    const Levels &levels, const Level &level, const float *point
) {
    return {
        cell(point[0] * levels.scale[0] + levels.shift[0], level.size),
        cell(point[1] * levels.scale[1] + levels.shift[1], level.size),
        cell(point[2] * levels.scale[2] + levels.shift[2], level.size),
    };
}

__device__ __forceinline__ InSpace in_space(
    const Level &level, const Cells &c, int chunk, int lane
) {
    int plane = level.size * level.size * CHANNELS;
    int second = level.chunks + chunk, third = 2 * level.chunks + chunk;
    return {
        bilinear(level.nodes, level.size, chunk * plane, c.x, c.y, lane),
        bilinear(level.nodes, level.size, second * plane, c.x, c.z, lane),
        bilinear(level.nodes, level.size, third * plane, c.y, c.z, lane),
    };
}

__device__ __forceinline__ InTime in_time(
    const Level &level, const Cells &c, int moment, int chunk, int lane
) {
    int line = level.size * CHANNELS, first = 3 * moment * level.chunks + chunk;
    return {
        linear(level.lines, first * line, c.x, lane),
        linear(level.lines, (first + level.chunks) * line, c.y, lane),
        linear(level.lines, (first + 2 * level.chunks) * line, c.z, lane),
    };
}

// Writes the levels side by side into rows of `width` features, n for each time; columns beyond are left as
// they are.
extern "C" __global__ void __launch_bounds__(THREADS) lookup(
    const __grid_constant__ Levels levels, int n, const float *points, int width, float *features
) {
    int thread = blockIdx.x * THREADS + threadIdx.x;
    int i = thread / CHANNELS, lane = thread % CHANNELS;
    if (i >= n) return;
    float *out = features + (size_t)i * width + lane;
    for (int l = 0; l < levels.count; l++) {
        const Level &level = levels.level[l];
        Cells c = cells_of(levels, level, points + 3 * (size_t)i);
        for (int chunk = 0; chunk < level.chunks; chunk++, out += CHANNELS) {
            InSpace s = in_space(level, c, chunk, lane);
            float of_space = s.xy.value * s.xz.value * s.yz.value;
            for (int m = 0; m < levels.moments; m++) {
                InTime t = in_time(level, c, m, chunk, lane);
                out[(size_t)m * n * width] = of_space * t.x.value * t.y.value * t.z.value;
            }
        }
    }
}

__device__ __forceinline__ void scatter_linear(float *line, int at, const Cell &c, float d) {
    float upper = d * c.upper_weight;
    atomicAdd(line + at, d - upper);
    atomicAdd(line + at + CHANNELS, upper);
}

__device__ __forceinline__ void scatter_bilinear(
    float *plane, int at, int row, const Cell &first, const Cell &second, float d
) {
    float upper = d * second.upper_weight;
    scatter_linear(plane, at, first, d - upper);
    scatter_linear(plane, at + row, first, upper);
}

// The sum over the 16 lanes of a point.
__device__ __forceinline__ float point_sum(float value) {
#pragma unroll
    for (int offset = CHANNELS / 2; offset > 0; offset /= 2)
        value += __shfl_xor_sync(ALL_LANES, value, offset);
    return value;
}

// Adds to d_space and d_lines, which begin as 0, and writes d_points (n, 3) unless it is null.
//
// Points outside the grid get no gradient along that axis; features without gradient cost no additions.
extern "C" __global__ void __launch_bounds__(THREADS) lookup_backward(
    const __grid_constant__ Levels levels, int n, const float *points, int width,
    const float *d_features, float *d_points
) {
    int thread = blockIdx.x * THREADS + threadIdx.x;
    int i = min(thread / CHANNELS, n - 1), lane = thread % CHANNELS;
    bool there = thread / CHANNELS < n;
    const float *given = d_features + (size_t)i * width + lane;
    float by_x = 0.0f, by_y = 0.0f, by_z = 0.0f;
    for (int l = 0; l < levels.count; l++) {
        const Level &level = levels.level[l];
        Cells c = cells_of(levels, level, points + 3 * (size_t)i);
        int row = level.size * CHANNELS;
        float cells = 0.5f * (level.size - 1);
        for (int chunk = 0; chunk < level.chunks; chunk++, given += CHANNELS) {
            bool taught = false;
            for (int m = 0; m < levels.moments; m++)
                taught |= given[(size_t)m * n * width] != 0.0f;
            if (!there || !taught) continue;
            InSpace s = in_space(level, c, chunk, lane);
            float of_space = s.xy.value * s.xz.value * s.yz.value;
            float gx = 0.0f, gy = 0.0f, gz = 0.0f, d_of_space = 0.0f;
            for (int m = 0; m < levels.moments; m++) {
                float d = given[(size_t)m * n * width];
                if (d == 0.0f) continue;
                InTime t = in_time(level, c, m, chunk, lane);
                d_of_space += d * (t.x.value * t.y.value * t.z.value);
                float d_x = d * of_space * t.y.value * t.z.value;
                float d_y = d * of_space * t.x.value * t.z.value;
                float d_z = d * of_space * t.x.value * t.y.value;
                gx += d_x * t.x.by_first, gy += d_y * t.y.by_first, gz += d_z * t.z.by_first;
                scatter_linear(level.d_lines, t.x.at, c.x, d_x);
                scatter_linear(level.d_lines, t.y.at, c.y, d_y);
                scatter_linear(level.d_lines, t.z.at, c.z, d_z);
            }
            float d_xy = d_of_space * s.xz.value * s.yz.value;
            float d_xz = d_of_space * s.xy.value * s.yz.value;
            float d_yz = d_of_space * s.xy.value * s.xz.value;
            gx += d_xy * s.xy.by_first + d_xz * s.xz.by_first;
            gy += d_xy * s.xy.by_second + d_yz * s.yz.by_first;
            gz += d_xz * s.xz.by_second + d_yz * s.yz.by_second;
            by_x += c.x.inside * cells * gx;
            by_y += c.y.inside * cells * gy;
            by_z += c.z.inside * cells * gz;
            scatter_bilinear(level.d_space, s.xy.at, row, c.x, c.y, d_xy);
            scatter_bilinear(level.d_space, s.xz.at, row, c.x, c.z, d_xz);
            scatter_bilinear(level.d_space, s.yz.at, row, c.y, c.z, d_yz);
        }
    }
    if (!d_points) return;
    by_x = point_sum(by_x), by_y = point_sum(by_y), by_z = point_sum(by_z);
    if (there && lane == 0) {
        d_points[3 * (size_t)i] = by_x * levels.scale[0];
        d_points[3 * (size_t)i + 1] = by_y * levels.scale[1];
        d_points[3 * (size_t)i + 2] = by_z * levels.scale[2];
    }
}
