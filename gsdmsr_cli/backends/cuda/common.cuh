// What all kernels share: cameras, limits and small helpers.
//
// The compiler is given the constants of splatting (gsdmsr_cli/splatting_constants.py) and the limits of
// compiler.py as macros. Tests compile the same sources with a host compiler, so nothing here needs a header.
#pragma once

#define ALL_LANES 0xffffffffu
#define WARP 32
#define LARGEST 3e38f  // what is not at most this is not finite
#define BLOCK_WIDTH 8  // of the pixels that a warp draws; a tile has 2 x 4 such blocks
#define BLOCK_HEIGHT 4
#define LOG2E 1.4426950408889634f
#define LN2 0.6931471805599453f

// A camera: rows of the rotation from world to camera, translation, intrinsics [px], centre [world].
struct View {
    float rotation[9];
    float translation[3];
    float fx, fy, cx, cy;
    float centre[3];
};

struct Views {
    View view[MOST_VIEWS];
};

// The pictures that views are compared with, (3, height, width) each.
struct Targets {
    const unsigned char *of_view[MOST_VIEWS];
};

__device__ __forceinline__ float slope_of_size(float x, float weight) {
    return x > 0.0f ? weight : x < 0.0f ? -weight : 0.0f;
}

// How far colours are apart: Huber's loss over q. steep is 1 / q and half q / 2, or steep so large
// that any difference is beyond q and half 0, which makes it |difference|.
__device__ __forceinline__ float distance_of(float difference, float steep, float half) {
    float apart = fabsf(difference), share = fminf(apart * steep, 1.0f);
    return share * (apart - share * half);
}

__device__ __forceinline__ float slope_of_distance(float difference, float weight, float steep) {
    return fmaxf(fminf(difference * (steep * weight), weight), -weight);
}

// The sum over the lanes of a warp, in every lane.
__device__ __forceinline__ float warp_sum(float value) {
    for (int offset = WARP / 2; offset > 0; offset /= 2)
        value += __shfl_xor_sync(ALL_LANES, value, offset);
    return value;
}
