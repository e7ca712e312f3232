// How much each of evenly spaced nodes counts at several times. A thread does one node of one time.
#include "common.cuh"

#define THREADS 128

struct Times {
    int count;
    float time[MOST_VIEWS];
};

extern "C" __global__ void __launch_bounds__(THREADS) hats(Times times, int nodes, float *found) {
    int i = blockIdx.x * THREADS + threadIdx.x;
    if (i >= times.count * nodes) return;
    float place = fminf(fmaxf(times.time[i / nodes], 0.0f), 1.0f) * (nodes - 1);
    found[i] = fmaxf(1.0f - fabsf(place - i % nodes), 0.0f);
}
