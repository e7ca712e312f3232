// Runs CUDA C on the CPU: enough of the language for this project's kernels, for tests alone.
//
// Blocks run one after another. The threads of a block are fibers: each runs until it waits for its
// warp or its block, then the next one's turn comes. So results do not depend on timing, and a kernel
// whose threads do not all reach a barrier is told of instead of hanging. Turns can be taken in the
// opposite order: what is missing a barrier then has another result.
#pragma once
#include <algorithm>
#include <cmath>
#include <csetjmp>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <deque>
#include <ucontext.h>
#include <utility>
#include <vector>

#define __global__
#define __device__
#define __host__
#define __forceinline__ inline
#define __noinline__ __attribute__((noinline))
#define __launch_bounds__(...)
#define __grid_constant__
#define __shared__ static
#define __constant__ static const

struct int2 { int x, y; };
struct alignas(8) float2 { float x, y; };
struct float3 { float x, y, z; };
struct alignas(16) float4 { float x, y, z, w; };
struct uint3 { unsigned x, y, z; };
inline int2 make_int2(int x, int y) { return {x, y}; }
inline float2 make_float2(float x, float y) { return {x, y}; }
inline float3 make_float3(float x, float y, float z) { return {x, y, z}; }
inline float4 make_float4(float x, float y, float z, float w) { return {x, y, z, w}; }

using std::max;
using std::min;

namespace shim {

constexpr int WARP_SIZE = 32;
constexpr size_t STACK = 128 << 10;

inline uint3 thread, block, block_size, grid_size;

// A barrier that opens when all threads which have not ended have come.
struct Barrier {
    int members = 0, waiting = 0;
    unsigned openings = 0;
};

struct Warp {
    Barrier barrier;
    uint32_t slots[2][WARP_SIZE];
    unsigned exchanges = 0;
};

struct Fiber {
    ucontext_t start;
    jmp_buf here;
    std::vector<char> stack;
    bool begun = false, ended = false;
};

inline std::deque<Fiber> fibers;  // which never moves what it holds
inline std::vector<Warp> warps;
inline Barrier whole;
inline int votes[2][2];  // by parity of the barrier: how many came, how many said yes
inline int current;
inline jmp_buf scheduler;
inline void (*work)(void *);
inline void *work_arguments;
inline unsigned long progress;
inline bool backwards;

// The place of turn i of n.
inline int turn(int i, int n) { return backwards ? n - 1 - i : i; }

inline void open(Barrier &barrier) {
    barrier.waiting = 0;
    barrier.openings++;
    progress++;
}

inline void yield() {
    if (_setjmp(fibers[current].here) == 0) _longjmp(scheduler, 1);
}

inline void wait(Barrier &barrier) {
    unsigned before = barrier.openings;
    if (++barrier.waiting == barrier.members) return open(barrier);
    while (barrier.openings == before) yield();
}

inline void leave(Barrier &barrier) {
    barrier.members--;
    if (barrier.members > 0 && barrier.waiting == barrier.members) open(barrier);
}

// What a fiber does for all its life: the same thread of one block after another.
inline void run_fiber() {
    for (;;) {
        work(work_arguments);
        fibers[current].ended = true;
        progress++;
        leave(warps[current / WARP_SIZE].barrier);
        leave(whole);
        yield();
    }
}

inline void resume(int index) {
    Fiber &fiber = fibers[index];
    current = index;
    thread = {(unsigned)index, 0, 0};
    if (_setjmp(scheduler) != 0) return;
    if (fiber.begun) _longjmp(fiber.here, 1);
    fiber.begun = true;
    progress++;
    getcontext(&fiber.start);
    fiber.stack.resize(STACK);
    fiber.start.uc_stack.ss_sp = fiber.stack.data();
    fiber.start.uc_stack.ss_size = STACK;
    fiber.start.uc_link = nullptr;
    makecontext(&fiber.start, run_fiber, 0);
    setcontext(&fiber.start);
}

// Lets the lanes of a warp take turns until all wait for the block or have ended.
inline bool run_warp(int first, int last) {
    bool left = false;
    for (unsigned long before = progress - 1; before != progress;) {
        before = progress;
        left = false;
        for (int k = 0; k < last - first; k++) {
            int i = first + turn(k, last - first);
            if (!fibers[i].ended) resume(i), left = left || !fibers[i].ended;
        }
    }
    return left;
}

inline void run_block() {
    int threads = block_size.x;
    if ((int)fibers.size() < threads) fibers.resize(threads);
    warps.assign((threads + WARP_SIZE - 1) / WARP_SIZE, Warp());
    whole = Barrier();
    whole.members = threads;
    memset(votes, 0, sizeof votes);
    for (int i = 0; i < threads; i++) {
        fibers[i].ended = false;
        warps[i / WARP_SIZE].barrier.members++;
    }
    for (bool left = true; left;) {
        unsigned long before = progress;
        left = false;
        for (int k = 0; k < (int)warps.size(); k++) {
            int first = turn(k, (int)warps.size()) * WARP_SIZE;
            left |= run_warp(first, std::min(first + WARP_SIZE, threads));
        }
        if (left && before == progress) {
            fprintf(stderr, "shim: threads wait for others that never come\n");
            abort();
        }
    }
}

inline void run_grid(int blocks_x, int blocks_y, int threads, void (*kernel)(void *), void *given) {
    work = kernel, work_arguments = given;
    grid_size = {(unsigned)blocks_x, (unsigned)blocks_y, 1};
    block_size = {(unsigned)threads, 1, 1};
    for (int y = 0; y < blocks_y; y++)
        for (int x = 0; x < blocks_x; x++) {
            block = {(unsigned)turn(x, blocks_x), (unsigned)turn(y, blocks_y), 0};
            run_block();
        }
}

// Calls a kernel with its arguments, of which `given` holds the addresses.
template <typename... A, size_t... I>
void call(void (*kernel)(A...), void **given, std::index_sequence<I...>) {
    kernel(*(std::remove_reference_t<A> *)given[I]...);
}
template <typename... A>
void call(void (*kernel)(A...), void **given) {
    call(kernel, given, std::index_sequence_for<A...>());
}

// Every lane gives four bytes and gets those of lane `from`.
inline uint32_t exchange(uint32_t mine, int from) {
    Warp &warp = warps[current / WARP_SIZE];
    unsigned turn = warp.barrier.openings & 1;
    warp.slots[turn][current % WARP_SIZE] = mine;
    wait(warp.barrier);
    return warp.slots[turn][from % WARP_SIZE];
}

template <typename T>
T shuffle(T value, int from) {
    static_assert(sizeof(T) == 4);
    uint32_t bits;
    memcpy(&bits, &value, 4);
    bits = exchange(bits, from);
    memcpy(&value, &bits, 4);
    return value;
}

inline unsigned ballot(bool vote) {
    Warp &warp = warps[current / WARP_SIZE];
    unsigned turn = warp.barrier.openings & 1, result = 0;
    int members = warp.barrier.members;
    warp.slots[turn][current % WARP_SIZE] = vote;
    wait(warp.barrier);
    for (int i = 0; i < members; i++) result |= warp.slots[turn][i] << i;
    return result;
}

inline int count_votes(bool vote, int &members) {
    unsigned turn = whole.openings & 1;
    votes[turn][0]++, votes[turn][1] += vote;
    wait(whole);
    members = votes[turn][0];
    int yes = votes[turn][1];
    static int readers;
    if (++readers == members) readers = 0, votes[turn][0] = votes[turn][1] = 0;
    return yes;
}

}  // namespace shim

#define threadIdx shim::thread
#define blockIdx shim::block
#define blockDim shim::block_size
#define gridDim shim::grid_size

inline void __syncthreads() { shim::wait(shim::whole); }
inline void __syncwarp(unsigned = 0xffffffffu) {
    shim::wait(shim::warps[shim::current / shim::WARP_SIZE].barrier);
}
inline int __syncthreads_count(int vote) { int n; return shim::count_votes(vote, n); }
inline int __syncthreads_and(int vote) { int n; return shim::count_votes(vote, n) == n; }
inline int __syncthreads_or(int vote) { int n; return shim::count_votes(vote, n) > 0; }
inline unsigned __ballot_sync(unsigned, bool vote) { return shim::ballot(vote); }
inline bool __any_sync(unsigned, bool vote) { return shim::ballot(vote) != 0; }
inline bool __all_sync(unsigned, bool vote) { return shim::ballot(!vote) == 0; }
template <typename T> T __shfl_sync(unsigned, T value, int lane) {
    return shim::shuffle(value, lane);
}
template <typename T> T __shfl_xor_sync(unsigned, T value, int mask) {
    return shim::shuffle(value, shim::current % shim::WARP_SIZE ^ mask);
}
template <typename T, typename U> T atomicAdd(T *at, U value) {
    T before = *at;
    *at += value;
    return before;
}
inline int __ffs(unsigned bits) { return __builtin_ffs((int)bits); }
inline int __popc(unsigned bits) { return __builtin_popcount(bits); }
inline int __float_as_int(float value) {
    int bits;
    memcpy(&bits, &value, 4);
    return bits;
}
inline unsigned __float_as_uint(float value) { return (unsigned)__float_as_int(value); }
inline float __uint_as_float(unsigned bits) {
    float value;
    memcpy(&value, &bits, 4);
    return value;
}
inline float __fdividef(float a, float b) { return a / b; }

// IEEE half precision: 1 bit of sign, 5 of an exponent with bias 15, 10 of a fraction.
inline float float_of_half(unsigned short bits) {
    int exponent = bits >> 10 & 31, fraction = bits & 1023;
    float size = exponent == 31 ? (fraction ? NAN : INFINITY)
        : exponent == 0 ? ldexpf((float)fraction, -24)
        : ldexpf((float)(1024 + fraction), exponent - 25);
    return bits >> 15 ? -size : size;
}
inline unsigned short half_of_float(float value) {
    unsigned short sign = std::signbit(value) ? 0x8000 : 0;
    if (std::isnan(value)) return 0x7fff;
    float size = fabsf(value);
    if (size >= 65520.0f) return sign | 0x7c00;  // midway between the largest and infinity
    // in units of the last bit, the smallest normal number's for those below it; to the nearest even
    int exponent = std::max(ilogbf(size), -14);
    int units = (int)nearbyintf(ldexpf(size, 10 - exponent));
    // a full fraction carries into the exponent, as it should
    return sign | (unsigned short)(((exponent + 14) << 10) + units);
}
