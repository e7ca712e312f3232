// Colours of directions on the faces of a cube, seen where a picture lets them through.
//
// A thread does one pixel of a picture in planes (3, height, width). The faces are at the lower and upper end
// of x, of y and of z; `points` (6, size, size) says which of the colours is at each place.
#include "common.cuh"

#define THREADS 128

// The ways from a pixel to the next of its row and of its column, and that of the first pixel.
struct Lines {
    float right[3], down[3], first[3];
};

// The points around a direction and their weights.
struct Corners {
    int point[4];
    float weight[4];
};

__device__ __forceinline__ float cell_of(float place, int size, int &lower) {
    float at = fminf(fmaxf((place + 1) * 0.5f * (size - 1), 0.0f), size - 1.0f);
    lower = min((int)at, size - 2);
    return at - lower;
}

__device__ __forceinline__ Corners corners_of(
    const Lines &lines, const long long *points, int size, int x, int y
) {
    float a = lines.first[0] + x * lines.right[0] + y * lines.down[0];
    float b = lines.first[1] + x * lines.right[1] + y * lines.down[1];
    float c = lines.first[2] + x * lines.right[2] + y * lines.down[2];
    float p = fabsf(a), q = fabsf(b), r = fabsf(c), u, v;
    int face, row, column;
    if (p >= q && p >= r)
        face = a > 0, u = b / p, v = c / p;
    else if (q >= r)
        face = 2 + (b > 0), u = c / q, v = a / q;
    else
        face = 4 + (c > 0), u = a / r, v = b / r;
    float s = cell_of(u, size, row), t = cell_of(v, size, column);
    const long long *at = points + ((size_t)face * size + row) * size + column;
    return {
        {(int)at[0], (int)at[1], (int)at[size], (int)at[size + 1]},
        {(1 - s) * (1 - t), (1 - s) * t, s * (1 - t), s * t},
    };
}

__device__ __forceinline__ float colour_of(const Corners &k, const float *colours, int c) {
    float colour = 0;
#pragma unroll
    for (int e = 0; e < 4; e++) colour += k.weight[e] * colours[3 * k.point[e] + c];
    return colour;
}

extern "C" __global__ void __launch_bounds__(THREADS) show(
    int width, int height, int size, const __grid_constant__ Lines lines, const float *planes,
    const float *alpha, const float *colours, const long long *points, float *found
) {
    int x = blockIdx.x * THREADS + threadIdx.x, y = blockIdx.y;
    if (x >= width) return;
    Corners k = corners_of(lines, points, size, x, y);
    size_t pixel = (size_t)y * width + x, area = (size_t)width * height;
    float through = 1 - alpha[pixel];
#pragma unroll
    for (int c = 0; c < 3; c++)
        found[c * area + pixel] = planes[c * area + pixel] + through * colour_of(k, colours, c);
}

// Adds to d_colours, which begin as 0.
extern "C" __global__ void __launch_bounds__(THREADS) show_backward(
    int width, int height, int size, const __grid_constant__ Lines lines, const float *alpha,
    const float *colours, const long long *points, const float *d_found, float *d_alpha,
    float *d_colours
) {
    int x = blockIdx.x * THREADS + threadIdx.x, y = blockIdx.y;
    if (x >= width) return;
    Corners k = corners_of(lines, points, size, x, y);
    size_t pixel = (size_t)y * width + x, area = (size_t)width * height;
    float through = 1 - alpha[pixel], total = 0;
#pragma unroll
    for (int c = 0; c < 3; c++) {
        float given = d_found[c * area + pixel];
        total -= given * colour_of(k, colours, c);
        given *= through;
        if (given == 0) continue;
#pragma unroll
        for (int e = 0; e < 4; e++) atomicAdd(d_colours + 3 * k.point[e] + c, k.weight[e] * given);
    }
    d_alpha[pixel] = total;
}
