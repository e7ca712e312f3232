// Lookups of plane grids in float32, and the penalties of grids, which are float32 whatever lookups read.
#define NODE float
#include "lookup.cuh"

// Writes the gradient of weight times the sum of squared first differences along both axes of the
// spatial planes of one level, and adds the value to *total (K-Planes, Fridovich-Keil et al. 2023).
extern "C" __global__ void __launch_bounds__(THREADS) space_penalty(
    int planes, int size, float weight, const float *space, float *d_space, double *total
) {
    int row = size * CHANNELS, k = blockIdx.x * THREADS + threadIdx.x;
    float value = 0.0f;
    if (k < planes * size * row) {
        int y = k / row % size, x = k / CHANNELS % size;
        float here = space[k], slope = 0.0f;
        if (x > 0) slope += here - space[k - CHANNELS];
        if (y > 0) slope += here - space[k - row];
        if (x + 1 < size) {
            float step = here - space[k + CHANNELS];
            slope += step, value += step * step;
        }
        if (y + 1 < size) {
            float step = here - space[k + row];
            slope += step, value += step * step;
        }
        d_space[k] = 2.0f * weight * slope;
    }
    value = warp_sum(weight * value);
    if (threadIdx.x % WARP == 0) atomicAdd(total, (double)value);
}

__device__ __forceinline__ float bend_at(const float *time, int k, int row) {
    return time[k - row] - 2.0f * time[k] + time[k + row];
}

// The same of smooth_weight times the squared second differences in time and still_weight times |1 -
// value| of the temporal planes of one level (HexPlane; 4D-GS, section 4.3).
extern "C" __global__ void __launch_bounds__(THREADS) time_penalty(
    int planes, int times, int size, float smooth_weight, float still_weight, const float *time,
    float *d_time, double *total
) {
    int row = size * CHANNELS, k = blockIdx.x * THREADS + threadIdx.x;
    float value = 0.0f;
    if (k < planes * times * row) {
        int t = k / row % times;
        float away = time[k] - 1.0f, slope = 0.0f;
        if (t > 0 && t + 1 < times) {
            float bend = bend_at(time, k, row);
            slope -= 2.0f * bend, value += smooth_weight * bend * bend;
        }
        if (t > 1) slope += bend_at(time, k - row, row);
        if (t + 2 < times) slope += bend_at(time, k + row, row);
        value += still_weight * fabsf(away);
        d_time[k] = 2.0f * smooth_weight * slope + slope_of_size(away, still_weight);
    }
    value = warp_sum(value);
    if (threadIdx.x % WARP == 0) atomicAdd(total, (double)value);
}
