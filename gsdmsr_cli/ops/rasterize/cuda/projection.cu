// Stored splats to the screen (EWA splatting, Zwicker et al. 2001, as in 3DGS) and gradients back.
//
// Notation: W rotates the world to the camera, M = R(q) diag(s) or the given axes, J is the projection's
// Jacobian at the centre. g and h are the two rows of J W M; the screen covariance is
// [[g.g + d, g.h], [g.h, h.h + d]] with the dilation d. What leaves is, for view v and splat i, in row
// v n + i: the centre, the shape (A, B, C, L) of alpha = 2^(L + A x^2 + B x y + C y^2), and the paint
// (red, green, blue, depth).
#include "common.cuh"
#include "harmonics.cuh"
#include "tiles.cuh"

#define LARGEST_DET 1e36f
#define TINY 1e-24f
#define NO_DEPTH 0x7fffffff  // sorts behind every depth

// Which tensors have rows of their own for each view (1), or the same rows for all (0).
struct Own {
    int means, quats, log_scales, logit_opacities, sh, axes;
};

// Either axes are null, or quats and log_scales are; gradients are null where these are.
struct Stored {
    const float *means, *quats, *log_scales, *logit_opacities, *sh, *axes;
};

struct Gradients {
    float *means, *quats, *log_scales, *logit_opacities, *sh, *axes;
};

// Rows of a 3 x 3 matrix.
struct Matrix {
    float m[9];
};

// The rotation of a quaternion of any length; (a, b, c, d) becomes the unit one, n its factor.
__device__ __forceinline__ Matrix rotation_of(float4 &q, float &n) {
    n = 1.0f / sqrtf(fmaxf(q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w, TINY));
    q = make_float4(q.x * n, q.y * n, q.z * n, q.w * n);
    float a = q.x, b = q.y, c = q.z, d = q.w;
    return {{1 - 2 * (c * c + d * d), 2 * (b * c - a * d), 2 * (b * d + a * c),
             2 * (b * c + a * d), 1 - 2 * (b * b + d * d), 2 * (c * d - a * b),
             2 * (b * d - a * c), 2 * (c * d + a * b), 1 - 2 * (b * b + c * c)}};
}

// The two factors of M = K diag(s), and with quaternions the unit one and what it was multiplied with.
struct Extent {
    Matrix k;
    float s[3];
    float4 q;
    float n;
};

// WITH_AXES: of a splat whose `first` are its axes; else of its quaternion, and `second` its log scales.
template <bool WITH_AXES>
__device__ __forceinline__ Extent extent_of(const float *first, const float *second) {
    Extent e;
    if (WITH_AXES) {
#pragma unroll
        for (int i = 0; i < 9; i++) e.k.m[i] = first[i];
        e.s[0] = e.s[1] = e.s[2] = 1.0f;
    } else {
        e.q = make_float4(first[0], first[1], first[2], first[3]);
#pragma unroll
        for (int i = 0; i < 3; i++) e.s[i] = expf(second[i]);
        e.k = rotation_of(e.q, e.n);
    }
    return e;
}

// Everything of a splat under a camera that both directions need.
struct Footprint {
    float depth, inverse_z, u_free, v_free, u, v, u_inside, v_inside;
    float wx[3], wy[3];  // rows of J W
    float g[3], h[3];
};

__device__ __forceinline__ float clamped(float u, float limit, float &inside) {
    inside = fabsf(u) <= limit ? 1.0f : 0.0f;
    return fminf(fmaxf(u, -limit), limit);
}

__device__ __forceinline__ Footprint footprint(
    const View &view, float x, float y, float z, const Extent &e, int width, int height
) {
    Footprint f;
    const float *r = view.rotation, *t = view.translation;
    f.depth = r[6] * x + r[7] * y + r[8] * z + t[2];
    f.inverse_z = 1.0f / f.depth;
    f.u_free = (r[0] * x + r[1] * y + r[2] * z + t[0]) * f.inverse_z;
    f.v_free = (r[3] * x + r[4] * y + r[5] * z + t[1]) * f.inverse_z;
    f.u = clamped(f.u_free, 0.5f * FRUSTUM_MARGIN * width / view.fx, f.u_inside);
    f.v = clamped(f.v_free, 0.5f * FRUSTUM_MARGIN * height / view.fy, f.v_inside);
    float fxz = view.fx * f.inverse_z, fyz = view.fy * f.inverse_z;
#pragma unroll
    for (int i = 0; i < 3; i++) {
        f.wx[i] = fxz * (r[i] - f.u * r[6 + i]);
        f.wy[i] = fyz * (r[3 + i] - f.v * r[6 + i]);
    }
#pragma unroll
    for (int i = 0; i < 3; i++) {
        f.g[i] = (f.wx[0] * e.k.m[i] + f.wx[1] * e.k.m[3 + i] + f.wx[2] * e.k.m[6 + i]) * e.s[i];
        f.h[i] = (f.wy[0] * e.k.m[i] + f.wy[1] * e.k.m[3 + i] + f.wy[2] * e.k.m[6 + i]) * e.s[i];
    }
    return f;
}

template <bool WITH_AXES>
__device__ __forceinline__ bool finite_row(
    const float *mean, const float *first, const float *second, float logit, const float *sh,
    int stored
) {
    float total = logit;
    if (WITH_AXES) {
        for (int k = 0; k < 3; k++) total += mean[k];
        for (int k = 0; k < 9; k++) total += first[k];
    } else {
        for (int k = 0; k < 3; k++) total += mean[k] + second[k];
        for (int k = 0; k < 4; k++) total += first[k];
    }
    for (int k = 0; k < 3 * stored; k++) total += sh[k];
    return fabsf(total) <= LARGEST;
}

__device__ __forceinline__ float3 direction(const View &view, const float *mean, float &inverse) {
    float x = mean[0] - view.centre[0], y = mean[1] - view.centre[1], z = mean[2] - view.centre[2];
    inverse = 1.0f / sqrtf(fmaxf(x * x + y * y + z * z, TINY));
    return make_float3(x * inverse, y * inverse, z * inverse);
}

__device__ __forceinline__ float4 paint_of(
    const View &view, const float *mean, const float *sh, int terms, float depth
) {
    float inverse, basis[MOST_TERMS];
    float3 d = direction(view, mean, inverse);
    sh_basis(d.x, d.y, d.z, terms, basis);
    float red = 0.5f, green = 0.5f, blue = 0.5f;
#pragma unroll
    for (int k = 0; k < MOST_TERMS; k++) {
        if (k >= terms) break;
        red += sh[3 * k] * basis[k], green += sh[3 * k + 1] * basis[k];
        blue += sh[3 * k + 2] * basis[k];
    }
    return make_float4(fmaxf(red, 0.0f), fmaxf(green, 0.0f), fmaxf(blue, 0.0f), depth);
}

// What M is made of: a splat's axes, or its quaternion and log scales.
template <bool WITH_AXES>
__device__ __forceinline__ const float *first_of(const Stored &s, const Own &own, size_t row, int i) {
    return WITH_AXES ? s.axes + 9 * (own.axes ? row : i) : s.quats + 4 * (own.quats ? row : i);
}

template <bool WITH_AXES>
__device__ __forceinline__ const float *second_of(const Stored &s, const Own &own, size_t row, int i) {
    return WITH_AXES ? nullptr : s.log_scales + 3 * (own.log_scales ? row : i);
}

// One thread per splat and view. Splats that are not drawn get radius 0, no tiles and zeros.
//
// sh has `stored` coefficients a splat, of which the first `terms` are used. keys are depths whose
// bits sort like integers; counts are numbers of tiles.
template <bool WITH_AXES>
__device__ __forceinline__ void project_splat(
    const Views &views, int n, const Stored &s, const Own &own, int stored, int terms, int width,
    int height, float2 *means2d, float4 *shapes, float4 *paints, float *radii, int *keys, int *counts
) {
    int i = blockIdx.x * blockDim.x + threadIdx.x, v = blockIdx.y;
    if (i >= n) return;
    const View &view = views.view[v];
    size_t row = (size_t)v * n + i;
    const float *mean = s.means + 3 * (own.means ? row : i);
    const float *first = first_of<WITH_AXES>(s, own, row, i);
    const float *second = second_of<WITH_AXES>(s, own, row, i);
    float logit = s.logit_opacities[own.logit_opacities ? row : i];
    const float *sh = s.sh + 3 * stored * (own.sh ? row : i);

    float2 centre = make_float2(0.0f, 0.0f);
    float4 shape = make_float4(0.0f, 0.0f, 0.0f, 0.0f), paint = shape;
    float radius = 0.0f;
    int key = NO_DEPTH, count = 0;
    float opacity = 1.0f / (1.0f + expf(-logit));
    float depth = view.rotation[6] * mean[0] + view.rotation[7] * mean[1]
        + view.rotation[8] * mean[2] + view.translation[2];
    if (depth > NEAR && opacity >= ALPHA_MIN
        && finite_row<WITH_AXES>(mean, first, second, logit, sh, stored)) {
        Extent e = extent_of<WITH_AXES>(first, second);
        Footprint f = footprint(view, mean[0], mean[1], mean[2], e, width, height);
        float gg = f.g[0] * f.g[0] + f.g[1] * f.g[1] + f.g[2] * f.g[2];
        float hh = f.h[0] * f.h[0] + f.h[1] * f.h[1] + f.h[2] * f.h[2];
        float gh = f.g[0] * f.h[0] + f.g[1] * f.h[1] + f.g[2] * f.h[2];
        // |g x h|^2 in place of gg hh - gh^2, which cancels for needles in float32
        float n0 = f.g[1] * f.h[2] - f.g[2] * f.h[1], n1 = f.g[2] * f.h[0] - f.g[0] * f.h[2];
        float n2 = f.g[0] * f.h[1] - f.g[1] * f.h[0];
        float det = n0 * n0 + n1 * n1 + n2 * n2 + DILATION * (gg + hh) + DILATION * DILATION;
        centre = make_float2(view.fx * f.u_free + view.cx, view.fy * f.v_free + view.cy);
        if (det <= LARGEST_DET && fabsf(centre.x) <= LARGEST && fabsf(centre.y) <= LARGEST) {
            float xx = gg + DILATION, yy = hh + DILATION, inverse = LOG2E / det;
            float extent = 2.0f * logf(opacity / ALPHA_MIN);
            float half_x = sqrtf(extent * xx), half_y = sqrtf(extent * yy);
            int2 across = pixel_range(centre.x - half_x, centre.x + half_x, width);
            int2 down = pixel_range(centre.y - half_y, centre.y + half_y, height);
            if (across.x <= across.y && down.x <= down.y) {
                shape = make_float4(
                    -0.5f * yy * inverse, gh * inverse, -0.5f * xx * inverse, log2f(opacity)
                );
                paint = paint_of(view, mean, sh, terms, f.depth);
                radius = fmaxf(half_x, half_y);
                key = __float_as_int(f.depth);
                count = walk_tiles<int>(centre, shape, width, height, i, 0, 0, nullptr, nullptr);
            }
        }
        if (radius == 0.0f) centre = make_float2(0.0f, 0.0f);
    }
    means2d[row] = centre;
    shapes[row] = shape;
    paints[row] = paint;
    radii[row] = radius;
    keys[row] = key;
    counts[row] = count;
}

extern "C" __global__ void __launch_bounds__(256) project(
    const __grid_constant__ Views views, int n, Stored s, Own own, int stored, int terms, int width,
    int height, float2 *means2d, float4 *shapes, float4 *paints, float *radii, int *keys, int *counts
) {
    project_splat<false>(
        views, n, s, own, stored, terms, width, height, means2d, shapes, paints, radii, keys, counts
    );
}

extern "C" __global__ void __launch_bounds__(256) project_axes(
    const __grid_constant__ Views views, int n, Stored s, Own own, int stored, int terms, int width,
    int height, float2 *means2d, float4 *shapes, float4 *paints, float *radii, int *keys, int *counts
) {
    project_splat<true>(
        views, n, s, own, stored, terms, width, height, means2d, shapes, paints, radii, keys, counts
    );
}

// What comes in, in the layout of what `project` writes: gradients of centres, shapes and paints.
struct Incoming {
    float2 centre;
    float4 shape, paint;
};

// The gradients of colour by the coefficients, added to d_sh, and by the mean, added to d_mean.
__device__ __forceinline__ void paint_backward(
    const View &view, const float *mean, const float *sh, int terms, float4 paint, float4 d_paint,
    float *d_mean, float *d_sh
) {
    float inverse, basis[MOST_TERMS], weights[MOST_TERMS];
    float3 d = direction(view, mean, inverse);
    sh_basis(d.x, d.y, d.z, terms, basis);
    float red = paint.x > 0.0f ? d_paint.x : 0.0f, green = paint.y > 0.0f ? d_paint.y : 0.0f;
    float blue = paint.z > 0.0f ? d_paint.z : 0.0f;
#pragma unroll
    for (int k = 0; k < MOST_TERMS; k++) {
        weights[k] = 0.0f;
        if (k >= terms) continue;
        d_sh[3 * k] += basis[k] * red;
        d_sh[3 * k + 1] += basis[k] * green;
        d_sh[3 * k + 2] += basis[k] * blue;
        weights[k] = sh[3 * k] * red + sh[3 * k + 1] * green + sh[3 * k + 2] * blue;
    }
    float3 slope = sh_slope(d.x, d.y, d.z, terms, weights);
    float along = slope.x * d.x + slope.y * d.y + slope.z * d.z;
    d_mean[0] += (slope.x - along * d.x) * inverse;
    d_mean[1] += (slope.y - along * d.y) * inverse;
    d_mean[2] += (slope.z - along * d.z) * inverse;
}

// Adds the gradient of a unit quaternion, given that of its rotation, through its length to d_quat.
__device__ __forceinline__ void rotation_backward(
    float4 q, float n, const float *d_k, float *d_quat
) {
    float a = q.x, b = q.y, c = q.z, d = q.w;
    float qa = 2 * (d * (d_k[3] - d_k[1]) + c * (d_k[2] - d_k[6]) + b * (d_k[7] - d_k[5]));
    float qb = 2 * (c * (d_k[3] + d_k[1]) + d * (d_k[6] + d_k[2]) - 2 * b * (d_k[4] + d_k[8])
                    + a * (d_k[7] - d_k[5]));
    float qc = 2 * (b * (d_k[3] + d_k[1]) + d * (d_k[7] + d_k[5]) - 2 * c * (d_k[0] + d_k[8])
                    + a * (d_k[2] - d_k[6]));
    float qd = 2 * (b * (d_k[6] + d_k[2]) + c * (d_k[7] + d_k[5]) - 2 * d * (d_k[0] + d_k[4])
                    + a * (d_k[3] - d_k[1]));
    float along = qa * a + qb * b + qc * c + qd * d;
    d_quat[0] += (qa - along * a) * n, d_quat[1] += (qb - along * b) * n;
    d_quat[2] += (qc - along * c) * n, d_quat[3] += (qd - along * d) * n;
}

// The gradients of position, and of axes or of rotation and scales, added to d_mean, d_first, d_second.
template <bool WITH_AXES>
__device__ __forceinline__ void shape_backward(
    const View &view, const float *mean, const float *first, const float *second, int width,
    int height, float4 shape, const Incoming &in, float *d_mean, float *d_first, float *d_second
) {
    Extent e = extent_of<WITH_AXES>(first, second);
    Footprint f = footprint(view, mean[0], mean[1], mean[2], e, width, height);
    const float *r = view.rotation;
    // screen covariance S = K^-1, so dL/dS = -K G K, where G holds dL/dK; the shape is K times
    // -log2(e) / 2, with its two mixed terms in one
    float ca = -2 * LN2 * shape.x, cb = -LN2 * shape.y, cc = -2 * LN2 * shape.z;
    float ga = -0.5f * LOG2E * in.shape.x, gb = -0.5f * LOG2E * in.shape.y;
    float gc = -0.5f * LOG2E * in.shape.z;
    float p00 = ca * ga + cb * gb, p01 = ca * gb + cb * gc;
    float p10 = cb * ga + cc * gb, p11 = cb * gb + cc * gc;
    float s_xx = -(p00 * ca + p01 * cb), s_xy = -(p00 * cb + p01 * cc);
    float s_yy = -(p10 * cb + p11 * cc);
    float e_x[3] = {0.0f, 0.0f, 0.0f}, e_y[3] = {0.0f, 0.0f, 0.0f}, d_k[9];
#pragma unroll
    for (int i = 0; i < 3; i++) {
        float dg = 2 * (s_xx * f.g[i] + s_xy * f.h[i]), dh = 2 * (s_xy * f.g[i] + s_yy * f.h[i]);
        float by_scale = 0.0f;
#pragma unroll
        for (int j = 0; j < 3; j++) {
            float m = e.k.m[3 * j + i] * e.s[i], d_m = f.wx[j] * dg + f.wy[j] * dh;
            by_scale += d_m * m;  // its product with M's columns is the gradient of the log scales
            d_k[3 * j + i] = d_m * e.s[i];
            e_x[j] += dg * m, e_y[j] += dh * m;  // by the rows of J W
        }
        if (!WITH_AXES) d_second[i] += by_scale;
    }
    if (WITH_AXES) {
#pragma unroll
        for (int i = 0; i < 9; i++) d_first[i] += d_k[i];
    } else {
        rotation_backward(e.q, e.n, d_k, d_first);
    }
    // through J W = f / z (R0 - u R2) and the projection of the centre
    float fxz = view.fx * f.inverse_z, fyz = view.fy * f.inverse_z;
    float du = in.centre.x * view.fx
        - f.u_inside * fxz * (e_x[0] * r[6] + e_x[1] * r[7] + e_x[2] * r[8]);
    float dv = in.centre.y * view.fy
        - f.v_inside * fyz * (e_y[0] * r[6] + e_y[1] * r[7] + e_y[2] * r[8]);
    float through_focal = e_x[0] * f.wx[0] + e_x[1] * f.wx[1] + e_x[2] * f.wx[2]
        + e_y[0] * f.wy[0] + e_y[1] * f.wy[1] + e_y[2] * f.wy[2];
    float dz = in.paint.w - f.inverse_z * (through_focal + du * f.u_free + dv * f.v_free);
    float dx = du * f.inverse_z, dy = dv * f.inverse_z;
#pragma unroll
    for (int i = 0; i < 3; i++) d_mean[i] += r[i] * dx + r[3 + i] * dy + r[6 + i] * dz;
}

// Writes `count` sums where the view has rows of its own or all views have been summed up.
__device__ __forceinline__ void store(
    float *out, const float *sums, int count, int own, size_t row, int i, bool last
) {
    if (own)
        for (int k = 0; k < count; k++) out[count * row + k] = sums[k];
    else if (last)
        for (int k = 0; k < count; k++) out[(size_t)count * i + k] = sums[k];
}

__device__ __forceinline__ void clear(float *sums, int count, bool now) {
    if (now)
        for (int k = 0; k < count; k++) sums[k] = 0.0f;
}

// One thread per splat, which goes through its views: tensors that all views share get the sum.
//
// d_sh is written by the thread that owns it; the caller sets it to 0 before. d_shapes is that of
// (A, B, C, L), d_paints that of (red, green, blue, depth). The kernels ask for 5 blocks on a
// multiprocessor: that is 96 registers, and none spill from sm_75 to sm_120, which hangs on the order:
// with the shape before the paint, NVRTC 13.0 spills one. Unasked, ptxas takes 96 to 128.
template <bool WITH_AXES>
__device__ __forceinline__ void project_splat_backward(
    const Views &views, int view_count, int n, const Stored &s, const Own &own, int stored,
    int terms, int width, int height, const float *radii, const float4 *shapes, const float4 *paints,
    const float2 *d_means2d, const float4 *d_shapes, const float4 *d_paints, const Gradients &d
) {
    const int own_first = WITH_AXES ? own.axes : own.quats, size = WITH_AXES ? 9 : 4;
    float *const to_first = WITH_AXES ? d.axes : d.quats;
    int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i >= n) return;
    float d_mean[3], d_first[WITH_AXES ? 9 : 4], d_second[3], d_logit[1];
    for (int v = 0; v < view_count; v++) {
        size_t row = (size_t)v * n + i;
        bool first = v == 0, last = v == view_count - 1;
        clear(d_mean, 3, first || own.means);
        clear(d_first, size, first || own_first);
        if (!WITH_AXES) clear(d_second, 3, first || own.log_scales);
        clear(d_logit, 1, first || own.logit_opacities);
        if (radii[row] > 0.0f) {
            const View &view = views.view[v];
            const float *mean = s.means + 3 * (own.means ? row : i);
            size_t sh_at = 3 * stored * (own.sh ? row : (size_t)i);
            Incoming in = {d_means2d[row], d_shapes[row], d_paints[row]};
            paint_backward(
                view, mean, s.sh + sh_at, terms, paints[row], in.paint, d_mean, d.sh + sh_at
            );
            shape_backward<WITH_AXES>(
                view, mean, first_of<WITH_AXES>(s, own, row, i),
                second_of<WITH_AXES>(s, own, row, i), width, height, shapes[row], in, d_mean,
                d_first, d_second
            );
            float logit = s.logit_opacities[own.logit_opacities ? row : i];
            d_logit[0] += LOG2E * in.shape.w / (1.0f + expf(logit));  // L = log2(sigmoid(logit))
        }
        store(d.means, d_mean, 3, own.means, row, i, last);
        store(to_first, d_first, size, own_first, row, i, last);
        if (!WITH_AXES) store(d.log_scales, d_second, 3, own.log_scales, row, i, last);
        store(d.logit_opacities, d_logit, 1, own.logit_opacities, row, i, last);
    }
}

extern "C" __global__ void __launch_bounds__(128, 5) project_backward(
    const __grid_constant__ Views views, int view_count, int n, Stored s, Own own, int stored,
    int terms, int width, int height, const float *radii, const float4 *shapes, const float4 *paints,
    const float2 *d_means2d, const float4 *d_shapes, const float4 *d_paints, Gradients d
) {
    project_splat_backward<false>(
        views, view_count, n, s, own, stored, terms, width, height, radii, shapes, paints, d_means2d,
        d_shapes, d_paints, d
    );
}

extern "C" __global__ void __launch_bounds__(128, 5) project_axes_backward(
    const __grid_constant__ Views views, int view_count, int n, Stored s, Own own, int stored,
    int terms, int width, int height, const float *radii, const float4 *shapes, const float4 *paints,
    const float2 *d_means2d, const float4 *d_shapes, const float4 *d_paints, Gradients d
) {
    project_splat_backward<true>(
        views, view_count, n, s, own, stored, terms, width, height, radii, shapes, paints, d_means2d,
        d_shapes, d_paints, d
    );
}
