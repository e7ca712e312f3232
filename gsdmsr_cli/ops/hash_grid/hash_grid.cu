// Looks features up in hash grids and scatters gradients back (Mueller et al. 2022, Instant-NGP).
//
// A table (rows, width) holds the values of all levels one after the other, from offsets[level] on. A level
// whose grid points are no more than `most` has a row for each, the first axis running fastest; in others
// they share `most` rows, a power of two, by a hash. A thread does one point on one level.
#include "common.cuh"

#define THREADS 256
#define MOST_AXES 4

struct HashLevels {
    int count, axes, width, most;
    unsigned factors[MOST_AXES];
    int sizes[MOST_HASH_LEVELS][MOST_AXES];
    int offsets[MOST_HASH_LEVELS + 1];
};

// The cell around a point: along each axis its lower grid point and the weight of the upper one.
struct HashCell {
    int lower[MOST_AXES];
    float upper[MOST_AXES];
};

template <int AXES>
__device__ __forceinline__ HashCell cell_of(const int *sizes, const float *point) {
    HashCell c;
#pragma unroll
    for (int a = 0; a < AXES; a++) {
        float last = (float)(sizes[a] - 1);
        float u = fminf(fmaxf((point[a] + 1.0f) * 0.5f * last, 0.0f), last);
        c.lower[a] = min((int)u, sizes[a] - 2);
        c.upper[a] = u - c.lower[a];
    }
    return c;
}

// The row of the table that holds a corner of a cell.
template <int AXES>
__device__ __forceinline__ int row_of(
    const HashLevels &levels, int level, const HashCell &c, int corner
) {
    const int *sizes = levels.sizes[level];
    unsigned long long points = 1;
#pragma unroll
    for (int a = 0; a < AXES; a++) points *= (unsigned)sizes[a];
    bool hashed = points > (unsigned)levels.most;
    unsigned row = 0, stride = 1;
#pragma unroll
    for (int a = 0; a < AXES; a++) {
        unsigned place = c.lower[a] + (corner >> a & 1);
        row = hashed ? row ^ place * levels.factors[a] : row + place * stride;
        stride *= sizes[a];
    }
    return levels.offsets[level] + (int)(hashed ? row & (levels.most - 1) : row);
}

// The weight of a corner of a cell, leaving one axis out if that is 0 or more.
template <int AXES>
__device__ __forceinline__ float weight_of(const HashCell &c, int corner, int but) {
    float weight = 1.0f;
#pragma unroll
    for (int a = 0; a < AXES; a++)
        if (a != but) weight *= corner >> a & 1 ? c.upper[a] : 1.0f - c.upper[a];
    return weight;
}

template <int AXES>
__device__ __forceinline__ void look_up(
    const HashLevels &levels, int level, const float *point, const float *table, float *out
) {
    HashCell c = cell_of<AXES>(levels.sizes[level], point);
    for (int k = 0; k < levels.width; k++) out[k] = 0.0f;
    for (int corner = 0; corner < 1 << AXES; corner++) {
        const float *values = table + (size_t)row_of<AXES>(levels, level, c, corner) * levels.width;
        float weight = weight_of<AXES>(c, corner, -1);
        for (int k = 0; k < levels.width; k++) out[k] += weight * values[k];
    }
}

// Writes (n, count * width) features, the levels side by side; one block along y per level.
extern "C" __global__ void __launch_bounds__(THREADS) lookup_hashed(
    const __grid_constant__ HashLevels levels, int n, const float *points, const float *table,
    float *features
) {
    int i = blockIdx.x * THREADS + threadIdx.x, level = blockIdx.y;
    if (i >= n) return;
    const float *point = points + (size_t)i * levels.axes;
    float *out = features + ((size_t)i * levels.count + level) * levels.width;
    if (levels.axes == 2) look_up<2>(levels, level, point, table, out);
    if (levels.axes == 3) look_up<3>(levels, level, point, table, out);
    if (levels.axes == 4) look_up<4>(levels, level, point, table, out);
}

__device__ __forceinline__ bool has_any(const float *given, int width) {
    bool any = false;
    for (int k = 0; k < width; k++) any |= given[k] != 0.0f;
    return any;
}

template <int AXES>
__device__ __forceinline__ void scatter(
    const HashLevels &levels, int level, const float *point, const float *given, float *d_table
) {
    HashCell c = cell_of<AXES>(levels.sizes[level], point);
    for (int corner = 0; corner < 1 << AXES; corner++) {
        unsigned at = row_of<AXES>(levels, level, c, corner) * (unsigned)levels.width;
        float weight = weight_of<AXES>(c, corner, -1);
        for (int k = 0; k < levels.width; k++)
            if (given[k] != 0.0f) atomicAdd(d_table + at + k, weight * given[k]);
    }
}

// Adds to d_table, which begins as 0; features without gradient cost no additions.
extern "C" __global__ void __launch_bounds__(THREADS) lookup_hashed_backward(
    const __grid_constant__ HashLevels levels, int n, const float *points, const float *d_features,
    float *d_table
) {
    int i = blockIdx.x * THREADS + threadIdx.x, level = blockIdx.y;
    if (i >= n) return;
    const float *point = points + (size_t)i * levels.axes;
    const float *given = d_features + ((size_t)i * levels.count + level) * levels.width;
    if (!has_any(given, levels.width)) return;
    if (levels.axes == 2) scatter<2>(levels, level, point, given, d_table);
    if (levels.axes == 3) scatter<3>(levels, level, point, given, d_table);
    if (levels.axes == 4) scatter<4>(levels, level, point, given, d_table);
}

template <int AXES>
__device__ __forceinline__ void add_slopes(
    const HashLevels &levels, int level, const float *point, const float *table, const float *given,
    float *d_point
) {
    HashCell c = cell_of<AXES>(levels.sizes[level], point);
    float slope[AXES] = {};
    for (int corner = 0; corner < 1 << AXES; corner++) {
        unsigned at = row_of<AXES>(levels, level, c, corner) * (unsigned)levels.width;
        float value = 0.0f;
        for (int k = 0; k < levels.width; k++)
            if (given[k] != 0.0f) value += given[k] * table[at + k];
#pragma unroll
        for (int a = 0; a < AXES; a++) {
            float d = value * weight_of<AXES>(c, corner, a);
            slope[a] += corner >> a & 1 ? d : -d;
        }
    }
#pragma unroll
    for (int a = 0; a < AXES; a++)
        if (fabsf(point[a]) <= 1.0f)
            atomicAdd(d_point + a, 0.5f * (levels.sizes[level][a] - 1) * slope[a]);
}

// Adds to d_points (n, axes), which begin as 0. Points outside get no gradient along that axis.
extern "C" __global__ void __launch_bounds__(THREADS) lookup_hashed_slopes(
    const __grid_constant__ HashLevels levels, int n, const float *points, const float *table,
    const float *d_features, float *d_points
) {
    int i = blockIdx.x * THREADS + threadIdx.x, level = blockIdx.y;
    if (i >= n) return;
    const float *point = points + (size_t)i * levels.axes;
    const float *given = d_features + ((size_t)i * levels.count + level) * levels.width;
    if (!has_any(given, levels.width)) return;
    float *d_point = d_points + (size_t)i * levels.axes;
    if (levels.axes == 2) add_slopes<2>(levels, level, point, table, given, d_point);
    if (levels.axes == 3) add_slopes<3>(levels, level, point, table, given, d_point);
    if (levels.axes == 4) add_slopes<4>(levels, level, point, table, given, d_point);
}
