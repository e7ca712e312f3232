// Adds to each splat the sum of a series of its own. A thread does one splat.
//
// A start has `columns` values for each splat, to the first `channels` of which is added `scale` times the
// sum of `terms` terms. A splat has `stored` coefficients of so many channels, of which the one `first` is
// the first that is read. The basis has a row for each splat, or one for all.
#include "common.cuh"

#define THREADS 128

extern "C" __global__ void __launch_bounds__(THREADS) add_series(
    int n, int columns, int stored, int channels, int rows, int terms, int first, float scale,
    const float *start, const float *coefficients, const float *basis, float *found
) {
    int i = blockIdx.x * THREADS + threadIdx.x;
    if (i >= n) return;
    const float *used = coefficients + ((size_t)i * stored + first) * channels;
    const float *own = rows > 1 ? basis + (size_t)i * terms : basis;
    for (int c = 0; c < columns; c++) {
        float total = 0.0f;
        if (c < channels)
            for (int k = 0; k < terms; k++) total += own[k] * used[k * channels + c];
        found[(size_t)i * columns + c] = start[(size_t)i * columns + c] + scale * total;
    }
}

// Writes all of d_coefficients, and d_basis where it is wanted; both are 0 where nothing is to be learnt.
extern "C" __global__ void __launch_bounds__(THREADS) add_series_backward(
    int n, int columns, int stored, int channels, int rows, int terms, int first, float scale,
    const float *coefficients, const float *basis, const float *d_found, float *d_coefficients,
    float *d_basis
) {
    int i = blockIdx.x * THREADS + threadIdx.x;
    if (i >= n) return;
    const float *given = d_found + (size_t)i * columns;
    const float *own = rows > 1 ? basis + (size_t)i * terms : basis;
    bool live = false;
    for (int c = 0; c < channels; c++) live |= given[c] != 0.0f;
    for (int k = 0; k < stored; k++) {
        bool used = live && k >= first && k < first + terms;
        float factor = used ? scale * own[k - first] : 0.0f;
        for (int c = 0; c < channels; c++)
            d_coefficients[((size_t)i * stored + k) * channels + c] = used ? factor * given[c] : 0.0f;
    }
    if (d_basis == nullptr) return;
    const float *read = coefficients + ((size_t)i * stored + first) * channels;
    for (int k = 0; k < terms; k++) {
        float total = 0.0f;
        for (int c = 0; c < channels && live; c++) total += given[c] * read[k * channels + c];
        d_basis[(size_t)i * terms + k] = scale * total;
    }
}
