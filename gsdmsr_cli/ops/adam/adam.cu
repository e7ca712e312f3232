// Adam over many tensors in one launch, with a multiplier per row and a true skip of rows (Kingma & Ba
// 2015).
#include "common.cuh"

#define THREADS 256

// One tensor: its values and moments; for those whose rows have multipliers the values per row, else
// width is 0; step is rate / (1 - beta1^t) and inverse2 is 1 / (1 - beta2^t).
struct Tensor {
    float *values;
    const float *gradient;
    float *first, *second;
    const float *multipliers;
    float *trace;
    int length, width;
    float step, inverse2;
};

struct Tensors {
    Tensor of[MOST_TENSORS];
};

// A grid of blocks by tensors. A multiplier scales the step, not the gradient, to which Adam is
// indifferent. A row with multiplier 0 keeps its values and moments; the trace gets the steps that
// all rows would have made with multiplier 1. rest1 and rest2 are 1 - beta1 and 1 - beta2, which float32
// would round. Nothing at all happens if *loss is not finite; null stands for a loss that is.
extern "C" __global__ void __launch_bounds__(THREADS) adam(
    const __grid_constant__ Tensors tensors, float beta1, float beta2, float rest1,
    float rest2, float eps, const float *loss
) {
    if (loss && !(fabsf(*loss) <= LARGEST)) return;
    const Tensor &tensor = tensors.of[blockIdx.y];
    for (int k = blockIdx.x * THREADS + threadIdx.x; k < tensor.length; k += gridDim.x * THREADS) {
        float gradient = tensor.gradient[k];
        float first = tensor.first[k] * beta1 + gradient * rest1;
        float second = tensor.second[k] * beta2 + gradient * gradient * rest2;
        float move = first * tensor.step / (sqrtf(second * tensor.inverse2) + eps);
        if (tensor.width > 0) {
            float factor = tensor.multipliers[k / tensor.width];
            tensor.trace[k] = move;
            if (factor == 0.0f) continue;
            move *= factor;
        }
        tensor.first[k] = first;
        tensor.second[k] = second;
        tensor.values[k] -= move;
    }
}
