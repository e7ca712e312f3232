// Slices of Gaussians in space and time. A thread does one splat.
//
// With the duration d, the tilt (b_0, b) and the scaled axes E of space, the covariance is M M^T. The first
// row of M is that of time, t = (d b_0, -E^T b), the others P = (d b | K E) with K = b_0 1 - [b]x. A slice has
// the variance t t, the velocity P t / (t t), and the axes P U, where the columns of U are u i, u j and u k for
// the unit quaternion u = t / sqrt(t t).
#include "common.cuh"

#define THREADS 128
#define SHORTEST 1e-12f  // quaternions count as this long at least

struct Unit {
    float w, x, y, z, norm;
};

// What a splat's slice is made of.
struct Rows {
    Unit turn, tilt;
    float scale[3], duration, axes[9], time[4], space[12];
};

__device__ __forceinline__ Unit unit_of(const float *q) {
    float norm = fmaxf(sqrtf(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]), SHORTEST);
    return {q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm, norm};
}

__device__ __forceinline__ Rows rows_of(
    const float *quat, const float *log_scale, const float *tilt, float log_duration
) {
    Rows m;
    m.turn = unit_of(quat), m.tilt = unit_of(tilt), m.duration = expf(log_duration);
    float w = m.turn.w, x = m.turn.x, y = m.turn.y, z = m.turn.z;
    float rotation[9] = {
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    };
    m.time[0] = m.duration * m.tilt.w;
    m.space[0] = m.duration * m.tilt.x;
    m.space[4] = m.duration * m.tilt.y;
    m.space[8] = m.duration * m.tilt.z;
#pragma unroll
    for (int c = 0; c < 3; c++) {
        m.scale[c] = expf(log_scale[c]);
#pragma unroll
        for (int r = 0; r < 3; r++) m.axes[3 * r + c] = rotation[3 * r + c] * m.scale[c];
        float e = m.axes[c], f = m.axes[3 + c], g = m.axes[6 + c];
        m.time[1 + c] = -(m.tilt.x * e + m.tilt.y * f + m.tilt.z * g);
        m.space[1 + c] = m.tilt.w * e + m.tilt.z * f - m.tilt.y * g;
        m.space[5 + c] = m.tilt.w * f + m.tilt.x * g - m.tilt.z * e;
        m.space[9 + c] = m.tilt.w * g + m.tilt.y * e - m.tilt.x * f;
    }
    return m;
}

__device__ __forceinline__ float square_of(const float *t) {
    return t[0] * t[0] + t[1] * t[1] + t[2] * t[2] + t[3] * t[3];
}

extern "C" __global__ void __launch_bounds__(THREADS) cut(
    int n, float least, const float *quats, const float *log_scales, const float *tilts,
    const float *log_durations, float *variances, float *velocities, float *axes
) {
    int i = blockIdx.x * THREADS + threadIdx.x;
    if (i >= n) return;
    Rows m = rows_of(quats + 4 * i, log_scales + 3 * i, tilts + 4 * i, log_durations[i]);
    float variance = fmaxf(square_of(m.time), least), steep = 1 / sqrtf(variance);
    float w = m.time[0] * steep, x = m.time[1] * steep, y = m.time[2] * steep, z = m.time[3] * steep;
    variances[i] = variance;
#pragma unroll
    for (int r = 0; r < 3; r++) {
        const float *p = m.space + 4 * r;
        float way = p[0] * m.time[0] + p[1] * m.time[1] + p[2] * m.time[2] + p[3] * m.time[3];
        velocities[3 * i + r] = way / variance;
        axes[9 * i + 3 * r] = w * p[1] - x * p[0] + z * p[2] - y * p[3];
        axes[9 * i + 3 * r + 1] = w * p[2] - y * p[0] + x * p[3] - z * p[1];
        axes[9 * i + 3 * r + 2] = w * p[3] - z * p[0] + y * p[1] - x * p[2];
    }
}

// Writes the gradients of a splat's rows into `d`, whose other members are left as they are.
__device__ __forceinline__ void rows_backward(
    const Rows &m, float least, float d_variance, const float *d_velocity, const float *d_axes, Rows &d
) {
    float found = square_of(m.time), variance = fmaxf(found, least);
    float inverse = 1 / variance, steep = 1 / sqrtf(variance), slope = d_variance;
    const float *t = m.time;
    float w = t[0] * steep, x = t[1] * steep, y = t[2] * steep, z = t[3] * steep;
    float d_unit[4] = {}, by_velocity[4] = {};
#pragma unroll
    for (int r = 0; r < 3; r++) {
        const float *p = m.space + 4 * r;
        float f = d_axes[3 * r], g = d_axes[3 * r + 1], h = d_axes[3 * r + 2];
        float given = d_velocity[r] * inverse;
        d.space[4 * r] = given * t[0] - x * f - y * g - z * h;
        d.space[4 * r + 1] = given * t[1] + w * f - z * g + y * h;
        d.space[4 * r + 2] = given * t[2] + z * f + w * g - x * h;
        d.space[4 * r + 3] = given * t[3] - y * f + x * g + w * h;
        d_unit[0] += p[1] * f + p[2] * g + p[3] * h;
        d_unit[1] += p[3] * g - p[0] * f - p[2] * h;
        d_unit[2] += p[1] * h - p[0] * g - p[3] * f;
        d_unit[3] += p[2] * f - p[0] * h - p[1] * g;
#pragma unroll
        for (int c = 0; c < 4; c++) by_velocity[c] += given * p[c];
        slope -= given * (p[0] * t[0] + p[1] * t[1] + p[2] * t[2] + p[3] * t[3]) * inverse;
    }
    slope -= 0.5f * inverse * (d_unit[0] * w + d_unit[1] * x + d_unit[2] * y + d_unit[3] * z);
    float twice = found >= least ? 2 * slope : 0.0f;
#pragma unroll
    for (int c = 0; c < 4; c++) d.time[c] = by_velocity[c] + d_unit[c] * steep + twice * t[c];
}

// Writes the gradients of the duration, the tilt in unit length and the axes, given those of the rows.
__device__ __forceinline__ void tilt_backward(const Rows &m, Rows &d) {
    const Unit &b = m.tilt;
    d.duration = d.time[0] * b.w + d.space[0] * b.x + d.space[4] * b.y + d.space[8] * b.z;
    d.tilt.w = d.time[0] * m.duration;
    d.tilt.x = d.space[0] * m.duration;
    d.tilt.y = d.space[4] * m.duration;
    d.tilt.z = d.space[8] * m.duration;
#pragma unroll
    for (int c = 0; c < 3; c++) {
        float x = m.axes[c], y = m.axes[3 + c], z = m.axes[6 + c], s = d.time[1 + c];
        float f = d.space[1 + c], g = d.space[5 + c], h = d.space[9 + c];
        d.tilt.w += f * x + g * y + h * z;
        d.tilt.x += g * z - h * y - s * x;
        d.tilt.y += h * x - f * z - s * y;
        d.tilt.z += f * y - g * x - s * z;
        d.axes[c] = b.w * f - b.z * g + b.y * h - b.x * s;
        d.axes[3 + c] = b.w * g - b.x * h + b.z * f - b.y * s;
        d.axes[6 + c] = b.w * h - b.y * f + b.x * g - b.z * s;
    }
}

__device__ __forceinline__ void unit_backward(const Unit &q, const Unit &d, float *d_q) {
    float along = q.norm > SHORTEST ? d.w * q.w + d.x * q.x + d.y * q.y + d.z * q.z : 0.0f;
    d_q[0] = (d.w - along * q.w) / q.norm;
    d_q[1] = (d.x - along * q.x) / q.norm;
    d_q[2] = (d.y - along * q.y) / q.norm;
    d_q[3] = (d.z - along * q.z) / q.norm;
}

// Writes the gradient of a unit quaternion, given that of its rotation, by rows.
__device__ __forceinline__ void rotation_backward(const Unit &q, const float *d, Unit &d_q) {
    d_q.w = 2 * (q.z * (d[3] - d[1]) + q.y * (d[2] - d[6]) + q.x * (d[7] - d[5]));
    d_q.x = 2 * (q.y * (d[3] + d[1]) + q.z * (d[6] + d[2]) - 2 * q.x * (d[4] + d[8]) + q.w * (d[7] - d[5]));
    d_q.y = 2 * (q.x * (d[3] + d[1]) + q.z * (d[7] + d[5]) - 2 * q.y * (d[0] + d[8]) + q.w * (d[2] - d[6]));
    d_q.z = 2 * (q.x * (d[6] + d[2]) + q.y * (d[7] + d[5]) - 2 * q.z * (d[0] + d[4]) + q.w * (d[3] - d[1]));
}

// All gradients are 0 where nothing is to be learnt.
extern "C" __global__ void __launch_bounds__(THREADS) cut_backward(
    int n, float least, const float *quats, const float *log_scales, const float *tilts,
    const float *log_durations, const float *d_variances, const float *d_velocities,
    const float *d_axes, float *d_quats, float *d_log_scales, float *d_tilts, float *d_log_durations
) {
    int i = blockIdx.x * THREADS + threadIdx.x;
    if (i >= n) return;
    bool live = d_variances[i] != 0.0f;
    for (int c = 0; c < 3; c++) live |= d_velocities[3 * i + c] != 0.0f;
    for (int c = 0; c < 9; c++) live |= d_axes[9 * i + c] != 0.0f;
    if (!live) {
        for (int c = 0; c < 4; c++) d_quats[4 * i + c] = d_tilts[4 * i + c] = 0.0f;
        for (int c = 0; c < 3; c++) d_log_scales[3 * i + c] = 0.0f;
        d_log_durations[i] = 0.0f;
        return;
    }
    Rows m = rows_of(quats + 4 * i, log_scales + 3 * i, tilts + 4 * i, log_durations[i]), d;
    rows_backward(m, least, d_variances[i], d_velocities + 3 * i, d_axes + 9 * i, d);
    tilt_backward(m, d);
    d_log_durations[i] = d.duration * m.duration;
    unit_backward(m.tilt, d.tilt, d_tilts + 4 * i);
#pragma unroll
    for (int c = 0; c < 3; c++) {
        float total = 0.0f;
#pragma unroll
        for (int r = 0; r < 3; r++) {
            total += d.axes[3 * r + c] * m.axes[3 * r + c];
            d.axes[3 * r + c] *= m.scale[c];
        }
        d_log_scales[3 * i + c] = total;
    }
    rotation_backward(m.turn, d.axes, d.turn);
    unit_backward(m.turn, d.turn, d_quats + 4 * i);
}
