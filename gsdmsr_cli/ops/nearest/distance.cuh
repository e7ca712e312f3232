// Distances between points and control points.
#pragma once

__device__ __forceinline__ float square_to(float x, float y, float z, const float *point) {
    float a = x - point[0], b = y - point[1], c = z - point[2];
    return a * a + b * b + c * c;
}
