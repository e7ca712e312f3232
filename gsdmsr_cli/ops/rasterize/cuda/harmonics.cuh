// Real spherical harmonics of degree 0 to 3 with 3DGS's factors and signs, and their slopes.
#pragma once
#include "common.cuh"

#define SH_0 0.28209479177387814f
#define SH_1 0.4886025119029199f
#define SH_20 1.0925484305920792f
#define SH_21 0.31539156525252005f
#define SH_22 0.5462742152960396f
#define SH_30 0.5900435899266435f
#define SH_31 2.890611442640554f
#define SH_32 0.4570457994644658f
#define SH_33 0.3731763325901154f
#define SH_34 1.445305721320277f
#define MOST_TERMS 16

// The first `terms` (1, 4, 9 or 16) basis functions at the unit direction (x, y, z); 0 for the rest.
__device__ __forceinline__ void sh_basis(float x, float y, float z, int terms, float *basis) {
#pragma unroll
    for (int k = 1; k < MOST_TERMS; k++) basis[k] = 0.0f;
    basis[0] = SH_0;
    if (terms > 1) basis[1] = -SH_1 * y, basis[2] = SH_1 * z, basis[3] = -SH_1 * x;
    float xx = x * x, yy = y * y, zz = z * z;
    if (terms > 4) {
        basis[4] = SH_20 * x * y, basis[5] = -SH_20 * y * z;
        basis[6] = SH_21 * (2 * zz - xx - yy);
        basis[7] = -SH_20 * x * z, basis[8] = SH_22 * (xx - yy);
    }
    if (terms > 9) {
        basis[9] = -SH_30 * y * (3 * xx - yy), basis[10] = SH_31 * x * y * z;
        basis[11] = -SH_32 * y * (4 * zz - xx - yy);
        basis[12] = SH_33 * z * (2 * zz - 3 * xx - 3 * yy);
        basis[13] = -SH_32 * x * (4 * zz - xx - yy);
        basis[14] = SH_34 * z * (xx - yy), basis[15] = -SH_30 * x * (xx - 3 * yy);
    }
}

// The gradient in (x, y, z) of the sum of w[k] times the k-th basis function.
__device__ __forceinline__ float3 sh_slope(float x, float y, float z, int terms, const float *w) {
    float3 g = make_float3(0.0f, 0.0f, 0.0f);
    if (terms > 1) g = make_float3(-SH_1 * w[3], -SH_1 * w[1], SH_1 * w[2]);
    if (terms > 4) {
        g.x += SH_20 * (y * w[4] - z * w[7]) + 2 * x * (SH_22 * w[8] - SH_21 * w[6]);
        g.y += SH_20 * (x * w[4] - z * w[5]) - 2 * y * (SH_22 * w[8] + SH_21 * w[6]);
        g.z += 4 * SH_21 * z * w[6] - SH_20 * (y * w[5] + x * w[7]);
    }
    if (terms > 9) {
        float xx = x * x, yy = y * y, zz = z * z, xy = x * y, xz = x * z, yz = y * z;
        g.x += -SH_30 * (6 * xy * w[9] + 3 * (xx - yy) * w[15]) + SH_31 * yz * w[10];
        g.x += SH_32 * (2 * xy * w[11] - (4 * zz - 3 * xx - yy) * w[13]);
        g.x += -6 * SH_33 * xz * w[12] + 2 * SH_34 * xz * w[14];
        g.y += -SH_30 * (3 * (xx - yy) * w[9] - 6 * xy * w[15]) + SH_31 * xz * w[10];
        g.y += SH_32 * (-(4 * zz - xx - 3 * yy) * w[11] + 2 * xy * w[13]);
        g.y += -6 * SH_33 * yz * w[12] - 2 * SH_34 * yz * w[14];
        g.z += SH_31 * xy * w[10] - 8 * SH_32 * (yz * w[11] + xz * w[13]);
        g.z += SH_33 * (6 * zz - 3 * xx - 3 * yy) * w[12] + SH_34 * (xx - yy) * w[14];
    }
    return g;
}
