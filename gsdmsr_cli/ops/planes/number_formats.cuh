// Formats of grids' values: how they are read into float32, and written by rounding to the nearest, ties to even.
//
// NVRTC's package has no cuda_fp16.h, so the conversions stand here: bfloat16 is the upper half of float32's
// bits, and for IEEE half precision the processor has instructions. The tests' compiler brings its own two.
#pragma once

struct Bf16 {
    unsigned short bits;
};

struct Fp16 {
    unsigned short bits;
};

#ifdef __CUDACC__
__device__ __forceinline__ float float_of_half(unsigned short bits) {
    float value;
    asm("cvt.f32.f16 %0, %1;" : "=f"(value) : "h"(bits));
    return value;
}

__device__ __forceinline__ unsigned short half_of_float(float value) {
    unsigned short bits;
    asm("cvt.rn.f16.f32 %0, %1;" : "=h"(bits) : "f"(value));
    return bits;
}
#endif

__device__ __forceinline__ float load(const float *at) { return *at; }
__device__ __forceinline__ float load(const Bf16 *at) {
    return __uint_as_float((unsigned)at->bits << 16);
}
__device__ __forceinline__ float load(const Fp16 *at) { return float_of_half(at->bits); }

__device__ __forceinline__ void store(float *at, float value) { *at = value; }
__device__ __forceinline__ void store(Bf16 *at, float value) {
    unsigned bits = __float_as_uint(value);
    // a number that is none stays none: adding to its bits could carry into the sign
    at->bits = value != value ? 0x7fff : (bits + 0x7fff + (bits >> 16 & 1)) >> 16;
}
__device__ __forceinline__ void store(Fp16 *at, float value) { at->bits = half_of_float(value); }
