// Finds the nearest of few queries, the control queries, for each of many.
#include "common.cuh"
#include "distance.cuh"

#define THREADS 128
#define KEPT 8  // control queries that one pass over all of them finds
#define SLACK 1.0001f  // a distance that is worked out anew may round otherwise than a bound on it

// A squared distance that the guessed points lie within, or LARGEST if they are no guess. Guesses are rows in
// ascending order.
__device__ __forceinline__ float bound_of(
    float x, float y, float z, const float *points, int kept, const int *near
) {
    float bound = 0.0f;
    for (int k = 0; k < kept; k++) {
        if (k > 0 && near[k] <= near[k - 1]) return LARGEST;
        float square = square_to(x, y, z, points + 3 * (size_t)near[k]);
        if (!(square <= LARGEST)) return LARGEST;
        bound = fmaxf(bound, square);
    }
    return fminf(bound * SLACK + 1e-30f, LARGEST);
}

// Finds the nearest points of each of n queries, exactly: near (n, kept) holds guesses, and gets the rows of the
// nearest in ascending order; of equally near ones the first. Of a query that is not finite it gets any rows.
//
// A block reads the points into shared memory once for all of its queries. Each thread keeps the 8 nearest in
// registers; where more are wanted, further passes find the 8 that come next, by distance and then by row.
extern "C" __global__ void __launch_bounds__(THREADS) nearest(
    int n, int count, int kept, const float *queries, const float *points, int *near
) {
    __shared__ float tile[3 * THREADS];
    int i = blockIdx.x * THREADS + threadIdx.x;
    bool there = i < n;
    const float *query = queries + 3 * (size_t)(there ? i : 0);
    float x = query[0], y = query[1], z = query[2], bound = LARGEST;
    int *own = near + (size_t)(there ? i : 0) * kept;
    if (there) bound = bound_of(x, y, z, points, kept, own);
    float last = -1.0f;  // the farthest of the passes before, and its row
    int last_row = -1;
    for (int found = 0; found < kept; found += KEPT) {
        int spare = max(found + KEPT - kept, 0), rows[KEPT];
        float best[KEPT];
#pragma unroll
        for (int k = 0; k < KEPT; k++) {
            best[k] = k < spare ? -1.0f : bound;  // nothing is nearer than what is spare
            rows[k] = max(found + k - spare, 0);
        }
        for (int start = 0; start < count; start += THREADS) {
            int held = min(THREADS, count - start);
            __syncthreads();
            for (int k = threadIdx.x; k < 3 * held; k += THREADS) tile[k] = points[3 * (size_t)start + k];
            __syncthreads();
            for (int j = 0; j < held; j++) {
                float square = square_to(x, y, z, tile + 3 * j);
                if (!(square < best[KEPT - 1])) continue;
                int row = start + j;
                if (square < last || (square == last && row <= last_row)) continue;
                // from the end on: those that are farther make room
#pragma unroll
                for (int k = KEPT - 1; k > 0; k--) {
                    if (square < best[k - 1]) {
                        best[k] = best[k - 1], rows[k] = rows[k - 1];
                    } else if (square < best[k]) {
                        best[k] = square, rows[k] = row;
                    }
                }
                if (square < best[0]) best[0] = square, rows[0] = row;
            }
        }
#pragma unroll
        for (int k = 0; k < KEPT; k++)
            if (there && k >= spare) own[found + k - spare] = rows[k];
        last = best[KEPT - 1], last_row = rows[KEPT - 1];
    }
    for (int k = 1; there && k < kept; k++) {
        int row = own[k], at = k;
        for (; at > 0 && own[at - 1] > row; at--) own[at] = own[at - 1];
        own[at] = row;
    }
}
