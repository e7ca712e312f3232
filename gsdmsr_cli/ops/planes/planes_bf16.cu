// Lookups of plane grids that are read in bfloat16.
#define NODE Bf16
#include "lookup.cuh"
