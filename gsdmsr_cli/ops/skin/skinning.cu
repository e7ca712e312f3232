// Lets splats follow the control points near them: blending of the points' transforms, gradients (linear blend
// skinning; SC-GS, Huang et al., CVPR 2024, section 3.2).
//
// A transform has 19 columns, each the difference from what leaves a splat alone: a 3x3 matrix by rows and an
// offset, which move a place x by (matrix x + offset); a quaternion, which turns q by (quaternion q); and an
// offset of the log scales. Values are computed by a thread per splat. The sums over the splats that follow a
// point are added by a warp: a lane per column, so that what a splat adds to a point is one access of 92 bytes.
#include "common.cuh"
#include "distance.cuh"

#define THREADS 128
#define OFFSET 9  // where the parts of a transform behind its matrix begin, and how many columns it has
#define QUAT 12
#define GROWTH 16
#define COLUMNS 19
#define SUMS 24      // per point: 19 columns, 3 of its place, 1 of its log radius, 1 unused
#define ADDED 23     // of which so many are added to
#define STRIDE 25    // of a splat's row in shared memory: odd, so that lanes use different banks

struct Quat {
    float w, x, y, z, norm;
};

// The quaternion of a point's deformation in unit length, and the length that it counts as having.
__device__ __forceinline__ Quat turn_of(const float *deformation, float shortest) {
    float w = 1.0f + deformation[3], x = deformation[4], y = deformation[5], z = deformation[6];
    float norm = fmaxf(sqrtf(w * w + x * x + y * y + z * z), shortest);
    return {w / norm, x / norm, y / norm, z / norm, norm};
}

// Writes what control points do at some times to the splats that follow them, (times, size, 19), from their places
// and deformations (times, size, 10): offsets of place, of the quaternion (1, 0, 0, 0), of log scales. The quaternion
// counts as `shortest` long at least; count is times * size.
extern "C" __global__ void __launch_bounds__(THREADS) transform(
    int count, int size, float shortest, const float *points, const float *deformation, float *transforms
) {
    int j = blockIdx.x * THREADS + threadIdx.x;
    if (j >= count) return;
    const float *point = points + 3 * (size_t)(j % size), *d = deformation + 10 * (size_t)j;
    float *out = transforms + COLUMNS * (size_t)j;
    Quat q = turn_of(d, shortest);
    float m[9] = {
        -2.0f * (q.y * q.y + q.z * q.z), 2.0f * (q.x * q.y - q.w * q.z), 2.0f * (q.x * q.z + q.w * q.y),
        2.0f * (q.x * q.y + q.w * q.z), -2.0f * (q.x * q.x + q.z * q.z), 2.0f * (q.y * q.z - q.w * q.x),
        2.0f * (q.x * q.z - q.w * q.y), 2.0f * (q.y * q.z + q.w * q.x), -2.0f * (q.x * q.x + q.y * q.y),
    };
#pragma unroll
    for (int r = 0; r < 3; r++) {
        float shift = d[r];
#pragma unroll
        for (int s = 0; s < 3; s++) {
            out[3 * r + s] = m[3 * r + s];
            shift -= m[3 * r + s] * point[s];
        }
        out[OFFSET + r] = shift;
        out[GROWTH + r] = d[7 + r];
    }
    out[QUAT] = q.w - 1.0f, out[QUAT + 1] = q.x, out[QUAT + 2] = q.y, out[QUAT + 3] = q.z;
}

// Writes the gradients of that, d_points (times, size, 3) and d_deformation (times, size, 10).
extern "C" __global__ void __launch_bounds__(THREADS) transform_backward(
    int count, int size, float shortest, const float *points, const float *deformation,
    const float *transforms, const float *d_transforms, float *d_points, float *d_deformation
) {
    int j = blockIdx.x * THREADS + threadIdx.x;
    if (j >= count) return;
    const float *point = points + 3 * (size_t)(j % size), *t = transforms + COLUMNS * (size_t)j;
    const float *given = d_transforms + COLUMNS * (size_t)j;
    float *out = d_deformation + 10 * (size_t)j;
    float m[9];
#pragma unroll
    for (int s = 0; s < 3; s++) {
        float pull = 0.0f;
#pragma unroll
        for (int r = 0; r < 3; r++) {
            m[3 * r + s] = given[3 * r + s] - given[OFFSET + r] * point[s];
            pull -= given[OFFSET + r] * t[3 * r + s];
        }
        d_points[3 * (size_t)j + s] = pull;
        out[s] = given[OFFSET + s], out[7 + s] = given[GROWTH + s];
    }
    Quat q = turn_of(deformation + 10 * (size_t)j, shortest);
    float a = given[QUAT]
        + 2.0f * (q.z * (m[3] - m[1]) + q.y * (m[2] - m[6]) + q.x * (m[7] - m[5]));
    float b = given[QUAT + 1] + 2.0f * (q.y * (m[3] + m[1]) + q.z * (m[6] + m[2])
        - 2.0f * q.x * (m[4] + m[8]) + q.w * (m[7] - m[5]));
    float c = given[QUAT + 2] + 2.0f * (q.x * (m[3] + m[1]) + q.z * (m[7] + m[5])
        - 2.0f * q.y * (m[0] + m[8]) + q.w * (m[2] - m[6]));
    float d = given[QUAT + 3] + 2.0f * (q.x * (m[6] + m[2]) + q.y * (m[7] + m[5])
        - 2.0f * q.z * (m[0] + m[4]) + q.w * (m[3] - m[1]));
    float along = a * q.w + b * q.x + c * q.y + d * q.z;
    out[3] = (a - along * q.w) / q.norm, out[4] = (b - along * q.x) / q.norm;
    out[5] = (c - along * q.y) / q.norm, out[6] = (d - along * q.z) / q.norm;
}

__device__ __forceinline__ float sharpness_of(float log_radius) { return expf(-2.0f * log_radius); }

// The mean of the transforms of a splat's points, in t (19 registers).
__device__ __forceinline__ void blend_into(
    float *t, const float *transforms, int kept, const int *near, const float *weights
) {
#pragma unroll
    for (int c = 0; c < COLUMNS; c++) t[c] = 0.0f;
    for (int k = 0; k < kept; k++) {
        const float *of_node = transforms + COLUMNS * (size_t)near[k];
        float weight = weights[k];
#pragma unroll
        for (int c = 0; c < COLUMNS; c++) t[c] += weight * of_node[c];
    }
}

// Writes n splats where their points take them at each time, (times, n, ...), and weights (n, kept), the same at all
// times: softmax(-d^2 / (2 r^2)) of the distances d to the points and their radii r. There are `size` points.
extern "C" __global__ void __launch_bounds__(THREADS) skin(
    int n, int kept, int times, int size, const float *means, const float *quats, const float *log_scales,
    const float *points, const float *log_radii, const float *transforms, const int *near,
    float *weights, float *moved, float *turned, float *scaled
) {
    int i = blockIdx.x * THREADS + threadIdx.x;
    if (i >= n) return;
    size_t three = 3 * (size_t)i, four = 4 * (size_t)i;
    float x = means[three], y = means[three + 1], z = means[three + 2];
    const int *own = near + (size_t)i * kept;
    float *weight = weights + (size_t)i * kept;
    float highest = -LARGEST, total = 0.0f;
    for (int k = 0; k < kept; k++) {
        int j = own[k];
        weight[k] = -0.5f * square_to(x, y, z, points + 3 * (size_t)j) * sharpness_of(log_radii[j]);
        highest = fmaxf(highest, weight[k]);
    }
    for (int k = 0; k < kept; k++) {
        weight[k] = expf(weight[k] - highest);
        total += weight[k];
    }
    for (int k = 0; k < kept; k++) weight[k] /= total;
    float qw = quats[four], qx = quats[four + 1], qy = quats[four + 2], qz = quats[four + 3];
    for (int time = 0; time < times; time++) {
        float t[COLUMNS];
        blend_into(t, transforms + COLUMNS * (size_t)time * size, kept, own, weight);
        size_t row = (size_t)time * n + i;
        float *place = moved + 3 * row, *scale = scaled + 3 * row, *quat = turned + 4 * row;
#pragma unroll
        for (int r = 0; r < 3; r++) {
            float shift = t[OFFSET + r] + t[3 * r] * x + t[3 * r + 1] * y + t[3 * r + 2] * z;
            place[r] = means[three + r] + shift;
            scale[r] = log_scales[three + r] + t[GROWTH + r];
        }
        float a = t[QUAT], b = t[QUAT + 1], c = t[QUAT + 2], d = t[QUAT + 3];
        quat[0] = qw + (a * qw - b * qx - c * qy - d * qz);
        quat[1] = qx + (a * qx + b * qw + c * qz - d * qy);
        quat[2] = qy + (a * qy - b * qz + c * qw + d * qx);
        quat[3] = qz + (a * qz + b * qy - c * qx + d * qw);
    }
}

// What a splat passes on: gradients of the transform it follows, 19 of them from `row` on in shared memory,
// and of its own mean and quaternion, which are written. Returns the sum over the transform of value times
// gradient, which is the mean that softmax's gradient needs.
__device__ __forceinline__ float pass_on(
    const float *t, float x, float y, float z, const float *quat, const float *d_moved,
    const float *d_turned, const float *d_scaled, float *row, float *d_mean, float *d_quat
) {
    float given[3] = {d_moved[0], d_moved[1], d_moved[2]}, at[3] = {x, y, z};
#pragma unroll
    for (int r = 0; r < 3; r++) {
        row[OFFSET + r] = given[r], row[GROWTH + r] = d_scaled[r];
        d_mean[r] = given[r] + t[r] * given[0] + t[3 + r] * given[1] + t[6 + r] * given[2];
#pragma unroll
        for (int s = 0; s < 3; s++) row[3 * r + s] = given[r] * at[s];
    }
    float a = t[QUAT], b = t[QUAT + 1], c = t[QUAT + 2], d = t[QUAT + 3];
    float w = quat[0], i = quat[1], j = quat[2], k = quat[3];
    float e = d_turned[0], f = d_turned[1], g = d_turned[2], h = d_turned[3];
    row[QUAT] = e * w + f * i + g * j + h * k;
    row[QUAT + 1] = -e * i + f * w - g * k + h * j;
    row[QUAT + 2] = -e * j + f * k + g * w - h * i;
    row[QUAT + 3] = -e * k - f * j + g * i + h * w;
    d_quat[0] = e + (e * a + f * b + g * c + h * d);
    d_quat[1] = f + (-e * b + f * a + g * d - h * c);
    d_quat[2] = g + (-e * c - f * d + g * a + h * b);
    d_quat[3] = h + (-e * d + f * c - g * b + h * a);
    float mean = 0.0f;
#pragma unroll
    for (int s = 0; s < COLUMNS; s++) mean += t[s] * row[s];
    return mean;
}

// Adds the k-th rows of a warp's splats to the sums of their points. What splats in a row add to the same point
// is added up first: where points are few, one addition takes the place of up to 32 that wait for each other.
__device__ __forceinline__ void add_rows(
    const float (*rows)[STRIDE], const int *followed, const float *weights, unsigned taught, int lane,
    float *sums
) {
    float total = 0.0f;
    for (unsigned left = taught; left; left &= left - 1) {
        int s = __ffs(left) - 1, next = __ffs(left & left - 1) - 1;
        float value = lane < ADDED ? rows[s][lane] : 0.0f;
        total += lane < COLUMNS ? weights[s] * value : value;
        if (next >= 0 && followed[next] == followed[s]) continue;
        if (lane < ADDED) atomicAdd(sums + (size_t)followed[s] * SUMS + lane, total);
        total = 0.0f;
    }
}

// Writes the gradients of that by means and quaternions, sums over the times, and adds those by the points to sums
// (times, size, 24), which begin as 0. That of log scales is the sum of d_scaled.
//
// A splat that is given no gradient adds nothing, whatever its values are: 0 times NaN would be NaN.
extern "C" __global__ void __launch_bounds__(THREADS) skin_backward(
    int n, int kept, int times, int size, const float *means, const float *quats, const float *points,
    const float *log_radii, const float *transforms, const int *near, const float *weights,
    const float *d_moved, const float *d_turned, const float *d_scaled, float *d_means,
    float *d_quats, float *sums
) {
    __shared__ float all_rows[THREADS / WARP][WARP][STRIDE], all_weights[THREADS];
    __shared__ int all_followed[THREADS];
    int i = blockIdx.x * THREADS + threadIdx.x, warp = threadIdx.x / WARP, lane = threadIdx.x % WARP;
    size_t at = i < n ? i : 0;
    float *row = all_rows[warp][lane];
    const float *mean = means + 3 * at, *weight = weights + at * kept;
    const int *rows_of_nodes = near + at * kept;
    float x = mean[0], y = mean[1], z = mean[2];
    float by_mean[3] = {}, by_quat[4] = {};
    for (int time = 0; time < times; time++) {
        size_t then = (size_t)time * n + at;
        const float *moved = d_moved + 3 * then, *turned = d_turned + 4 * then, *scaled = d_scaled + 3 * then;
        const float *transforms_then = transforms + COLUMNS * (size_t)time * size;
        float average = 0.0f;
        bool own = false;
#pragma unroll
        for (int r = 0; r < 3; r++) own |= i < n && (moved[r] != 0.0f || scaled[r] != 0.0f);
#pragma unroll
        for (int r = 0; r < 4; r++) own |= i < n && turned[r] != 0.0f;
        if (own) {
            float t[COLUMNS], passed[7];
            blend_into(t, transforms_then, kept, rows_of_nodes, weight);
            average = pass_on(t, x, y, z, quats + 4 * at, moved, turned, scaled, row, passed, passed + 3);
#pragma unroll
            for (int r = 0; r < 3; r++) by_mean[r] += passed[r];
#pragma unroll
            for (int r = 0; r < 4; r++) by_quat[r] += passed[3 + r];
        }
        unsigned taught = __ballot_sync(ALL_LANES, own);
        for (int k = 0; k < kept; k++) {
            __syncwarp();
            if (own) {
                int j = rows_of_nodes[k];
                const float *point = points + 3 * (size_t)j, *transform = transforms_then + COLUMNS * (size_t)j;
                float total = 0.0f;
#pragma unroll
                for (int s = 0; s < COLUMNS; s++) total += transform[s] * row[s];
                float given = weight[k] * (total - average) * sharpness_of(log_radii[j]);
                float away[3] = {x - point[0], y - point[1], z - point[2]};
#pragma unroll
                for (int s = 0; s < 3; s++) {
                    row[COLUMNS + s] = given * away[s];
                    by_mean[s] -= given * away[s];
                }
                row[COLUMNS + 3] = given * (away[0] * away[0] + away[1] * away[1] + away[2] * away[2]);
                all_weights[threadIdx.x] = weight[k];
                all_followed[threadIdx.x] = j;
            }
            __syncwarp();
            const float *weights_there = all_weights + warp * WARP;
            float *sums_then = sums + SUMS * (size_t)time * size;
            add_rows(all_rows[warp], all_followed + warp * WARP, weights_there, taught, lane, sums_then);
        }
        __syncwarp();  // rows are read by all lanes before the next time's are written
    }
    if (i >= n) return;
#pragma unroll
    for (int r = 0; r < 3; r++) d_means[3 * at + r] = by_mean[r];
#pragma unroll
    for (int r = 0; r < 4; r++) d_quats[4 * at + r] = by_quat[r];
}
