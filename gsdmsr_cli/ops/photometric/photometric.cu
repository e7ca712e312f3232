// How far drawn pictures are from 8-bit targets by colours and by SSIM, with the gradients.
//
// SSIM is that of 3DGS: an 11 x 11 Gaussian window of sigma 1.5, zero padding, averaged over pixels
// and channels (Wang et al. 2004). A block of threads does one tile of one channel: it reads the tile
// with a margin into shared memory and blurs along rows, then along columns. Both kernels have a grid
// of tiles by views times channels; pictures are planes (views, 3, height, width).
#include "common.cuh"

#define REACH 5
#define TAPS (2 * REACH + 1)
#define WIDE (TILE + 2 * REACH)
#define THREADS (TILE * TILE)
#define C1 (0.01f * 0.01f)
#define C2 (0.03f * 0.03f)

// exp(-d^2 / (2 * 1.5^2)) / sum, for distances d from 0 to 5
__device__ __forceinline__ float tap(int distance) {
    const float window[REACH + 1] = {
        0.26601171f, 0.21300554f, 0.10936069f, 0.036000773f, 0.0075987582f, 0.0010283801f,
    };
    return window[distance];
}

struct Spot {
    int column, row, channel, view;
    bool inside;
    size_t plane;  // where the channel's plane begins
};

__device__ __forceinline__ Spot spot(int width, int height) {
    int columns = (width + TILE - 1) / TILE;
    Spot s;
    s.channel = blockIdx.y % 3, s.view = blockIdx.y / 3;
    s.column = blockIdx.x % columns * TILE + threadIdx.x % TILE;
    s.row = blockIdx.x / columns * TILE + threadIdx.x / TILE;
    s.inside = s.column < width && s.row < height;
    s.plane = (size_t)blockIdx.y * height * width;
    return s;
}

__device__ __forceinline__ float along_row(const float (*wide)[WIDE], int row, int column) {
    float sum = 0.0f;
#pragma unroll
    for (int k = -REACH; k <= REACH; k++)
        sum += tap(k < 0 ? -k : k) * wide[row][column + REACH + k];
    return sum;
}

__device__ __forceinline__ float along_column(const float (*blurred)[TILE], int row, int column) {
    float sum = 0.0f;
#pragma unroll
    for (int k = -REACH; k <= REACH; k++)
        sum += tap(k < 0 ? -k : k) * blurred[row + REACH + k][column];
    return sum;
}

// Adds up one value per thread of the block; the result is in thread 0.
__device__ __forceinline__ float block_sum(float value, float *shares) {
    value = warp_sum(value);
    if (threadIdx.x % WARP == 0) shares[threadIdx.x / WARP] = value;
    __syncthreads();
    float total = 0.0f;
    if (threadIdx.x == 0)
        for (int i = 0; i < THREADS / WARP; i++) total += shares[i];
    return total;
}

// Writes the derivatives of SSIM by the blurred x, x x and x y, which its gradient is made of.
//
// maps are (3, views, 3, height, width); sums (views, 3, tiles) get the sum of SSIM over each tile.
extern "C" __global__ void __launch_bounds__(THREADS) ssim_maps(
    int width, int height, const float *drawn, const __grid_constant__ Targets targets,
    float *maps, float *sums
) {
    __shared__ float x[WIDE][WIDE], y[WIDE][WIDE], mixed[WIDE][WIDE];
    __shared__ float blurred[4][WIDE][TILE];
    __shared__ float shares[THREADS / WARP];
    Spot s = spot(width, height);
    const unsigned char *target = targets.of_view[s.view] + (size_t)s.channel * height * width;
    int left = s.column - threadIdx.x % TILE - REACH, top = s.row - threadIdx.x / TILE - REACH;
    for (int k = threadIdx.x; k < WIDE * WIDE; k += THREADS) {
        int row = top + k / WIDE, column = left + k % WIDE;
        bool inside = row >= 0 && row < height && column >= 0 && column < width;
        size_t at = (size_t)row * width + column;
        x[k / WIDE][k % WIDE] = inside ? drawn[s.plane + at] : 0.0f;
        y[k / WIDE][k % WIDE] = inside ? target[at] * (1.0f / 255.0f) : 0.0f;
    }
    __syncthreads();
    // only the sum of the squares matters, since the variances enter SSIM as a sum
    for (int pass = 0; pass < 2; pass++) {
        for (int k = threadIdx.x; k < WIDE * WIDE; k += THREADS) {
            float a = x[k / WIDE][k % WIDE], b = y[k / WIDE][k % WIDE];
            mixed[k / WIDE][k % WIDE] = pass == 0 ? a * a + b * b : a * b;
        }
        __syncthreads();
        for (int k = threadIdx.x; k < WIDE * TILE; k += THREADS) {
            int row = k / TILE, column = k % TILE;
            blurred[pass][row][column] = along_row(pass == 0 ? x : y, row, column);
            blurred[2 + pass][row][column] = along_row(mixed, row, column);
        }
        __syncthreads();
    }
    int row = threadIdx.x / TILE, column = threadIdx.x % TILE;
    float mx = along_column(blurred[0], row, column), my = along_column(blurred[1], row, column);
    float squares = along_column(blurred[2], row, column);
    float mxy = along_column(blurred[3], row, column);
    float cross = mx * my, square = mx * mx + my * my;
    float inverse1 = 1.0f / (square + C1), inverse2 = 1.0f / (squares - square + C2);
    float luminance = (2 * cross + C1) * inverse1;
    float structure = (2 * (mxy - cross) + C2) * inverse2;
    float value = luminance * structure;
    if (s.inside) {
        float by_xx = -value * inverse2, by_xy = 2 * luminance * inverse2;
        float by_x = 2 * (my - mx * luminance) * structure * inverse1 - 2 * mx * by_xx - my * by_xy;
        size_t size = (size_t)gridDim.y * height * width;
        size_t at = s.plane + (size_t)s.row * width + s.column;
        maps[at] = by_x, maps[at + size] = by_xx, maps[at + 2 * size] = by_xy;
    }
    float total = block_sum(s.inside ? value : 0.0f, shares);
    if (threadIdx.x == 0) sums[blockIdx.y * gridDim.x + blockIdx.x] = total;
}

// Writes weight times the slope of the distance plus ssim_weight times that of the sum of SSIM.
//
// sums (views, 3, tiles) get the sum of distances over each tile.
extern "C" __global__ void __launch_bounds__(THREADS) photometric_gradient(
    int width, int height, const float *drawn, const __grid_constant__ Targets targets,
    const float *maps, float weight, float steep, float half, float ssim_weight, float *gradient,
    float *sums
) {
    __shared__ float wide[WIDE][WIDE];
    __shared__ float blurred[WIDE][TILE];
    __shared__ float shares[THREADS / WARP];
    Spot s = spot(width, height);
    int left = s.column - threadIdx.x % TILE - REACH, top = s.row - threadIdx.x / TILE - REACH;
    size_t size = (size_t)gridDim.y * height * width;
    float parts[3];
#pragma unroll
    for (int map = 0; map < 3; map++) {
        for (int k = threadIdx.x; k < WIDE * WIDE; k += THREADS) {
            int row = top + k / WIDE, column = left + k % WIDE;
            bool inside = row >= 0 && row < height && column >= 0 && column < width;
            size_t at = map * size + s.plane + (size_t)row * width + column;
            wide[k / WIDE][k % WIDE] = inside ? maps[at] : 0.0f;
        }
        __syncthreads();
        for (int k = threadIdx.x; k < WIDE * TILE; k += THREADS)
            blurred[k / TILE][k % TILE] = along_row(wide, k / TILE, k % TILE);
        __syncthreads();
        parts[map] = along_column(blurred, threadIdx.x / TILE, threadIdx.x % TILE);
    }
    float distance = 0.0f;
    if (s.inside) {
        size_t at = (size_t)s.row * width + s.column;
        const unsigned char *target = targets.of_view[s.view] + (size_t)s.channel * height * width;
        float x = drawn[s.plane + at], y = target[at] * (1.0f / 255.0f);
        distance = distance_of(x - y, steep, half);
        gradient[s.plane + at] = slope_of_distance(x - y, weight, steep)
            + ssim_weight * (parts[0] + 2 * x * parts[1] + y * parts[2]);
    }
    float total = block_sum(distance, shares);
    if (threadIdx.x == 0) sums[blockIdx.y * gridDim.x + blockIdx.x] = total;
}
