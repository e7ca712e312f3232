// Lookups of plane grids that are read in IEEE half precision.
#define NODE Fp16
#include "lookup.cuh"
