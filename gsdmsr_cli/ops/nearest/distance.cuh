// Distances between points and control points.
#pragma once

__device__ __forceinline__ float square_to(float x, float y, float z, const float *node) {
    float a = x - node[0], b = y - node[1], c = z - node[2];
    return a * a + b * b + c * c;
}
