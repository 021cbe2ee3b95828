// What gsplat's kernels use of CUDA, on a processor. Every CUDA thread is a fiber; the blocks of a grid run one after
// the other, and the fibers of a block in turns, each until it waits for others. Included before every source.
#pragma once
#include <math.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <memory>
#include <numeric>
#include <vector>

#define __global__
#define __device__
#define __host__
#define __forceinline__ inline
#define __launch_bounds__(...)

struct dim3 {
    unsigned x, y, z;
    constexpr dim3(unsigned x = 1, unsigned y = 1, unsigned z = 1) : x(x), y(y), z(z) {}
};
struct uint2 { unsigned x, y; };
struct uint3 { unsigned x, y, z; };

// ---- threads and blocks

namespace emulation {

constexpr unsigned WARP = 32;

struct Block {
    dim3 grid, size;
    uint3 index;
    unsigned threads;
    char *shared;  // memory
};
struct Place {  // of a thread in its block
    uint3 index;
    unsigned rank;
    unsigned lane() const { return rank % WARP; }
};
extern Block block;        // that runs
extern const Place *here;  // of the thread that runs
extern long launches;      // so far

// Runs `body` once for every thread of the grid.
void run_grid(dim3 grid, dim3 size, size_t shared_bytes, const std::function<void()> &body);

// A meeting: waits until all living threads of the set are here, then `combine` reads and writes what they brought.
// The set are lanes of the thread's warp, or the whole block.
using Combine = void (*)(void **brought, unsigned count);
constexpr uint32_t WHOLE_BLOCK = 0;
void meet(uint32_t lanes, void *brought, Combine combine);

// kernel<<<grid, size, shared_bytes, stream>>>(arguments...)
template <class Kernel, class... Arguments>
void launch(dim3 grid, dim3 size, size_t shared_bytes, int /* stream */, Kernel kernel, Arguments... arguments) {
    run_grid(grid, size, shared_bytes, [&] { kernel(arguments...); });
}

}  // namespace emulation

#define threadIdx (emulation::here->index)
#define blockIdx (emulation::block.index)
#define blockDim (emulation::block.size)
#define gridDim (emulation::block.grid)

inline int __syncthreads_count(int flag) {
    int count = flag != 0;
    emulation::meet(emulation::WHOLE_BLOCK, &count, [](void **brought, unsigned threads) {
        int sum = 0;
        for (unsigned i = 0; i < threads; ++i) sum += *(int *)brought[i];
        for (unsigned i = 0; i < threads; ++i) *(int *)brought[i] = sum;
    });
    return count;
}
inline void __syncthreads() { __syncthreads_count(0); }

// Threads change only where they meet, so an addition is atomic.
template <class T, class V> void gpuAtomicAdd(T *sum, V value) { *sum += (T)value; }

// ---- cooperative groups

namespace cooperative_groups {

struct grid_group {
    uint64_t thread_rank() const {
        const emulation::Block &at = emulation::block;
        uint64_t before = ((uint64_t)at.index.z * at.grid.y + at.index.y) * at.grid.x + at.index.x;
        return before * at.threads + emulation::here->rank;
    }
};
inline grid_group this_grid() { return {}; }

struct thread_block {
    uint3 group_index() const { return blockIdx; }
    uint3 thread_index() const { return threadIdx; }
    unsigned thread_rank() const { return emulation::here->rank; }
    unsigned size() const { return emulation::block.threads; }
    void sync() const { __syncthreads(); }
};
inline thread_block this_thread_block() { return {}; }

template <class T> struct plus { T operator()(T a, T b) const { return a + b; } };
template <class T> struct greater { T operator()(T a, T b) const { return a > b ? a : b; } };

// Some lanes of a warp, as a mask.
struct lane_group {
    uint32_t lanes;
    unsigned thread_rank() const { return __builtin_popcount(lanes & ((1u << emulation::here->lane()) - 1)); }
    unsigned size() const { return __builtin_popcount(lanes); }
    int any(int flag) const;
};
template <unsigned N> struct thread_block_tile : lane_group {
    static_assert(N == emulation::WARP);
};

template <unsigned N> thread_block_tile<N> tiled_partition(const thread_block &) {
    unsigned left = emulation::block.threads - emulation::here->rank / N * N;  // the last warp may not be full
    return {{left >= N ? ~0u : (1u << left) - 1}};
}

// The lanes that have the same label.
template <class T> lane_group labeled_partition(const lane_group &warp, T label) {
    struct Labeled { T label; unsigned lane; uint32_t equal; } own{label, emulation::here->lane(), 0};
    emulation::meet(warp.lanes, &own, [](void **brought, unsigned count) {
        auto of = [&](unsigned i) { return (Labeled *)brought[i]; };
        for (unsigned i = 0; i < count; ++i)
            for (unsigned j = 0; j < count; ++j)
                if (of(i)->label == of(j)->label) of(i)->equal |= 1u << of(j)->lane;
    });
    return {own.equal};
}

// By halves, as the lanes of a GPU do it: the sums are rounded in that order.
template <class T, class Operation> T reduce(const lane_group &group, T value, Operation) {
    emulation::meet(group.lanes, &value, [](void **brought, unsigned count) {
        T parts[emulation::WARP];
        for (unsigned i = 0; i < count; ++i) parts[i] = *(T *)brought[i];
        for (unsigned left = count; left > 1; left = (left + 1) / 2)
            for (unsigned half = (left + 1) / 2, i = 0; i + half < left; ++i)
                parts[i] = Operation()(parts[i], parts[i + half]);
        for (unsigned i = 0; i < count; ++i) *(T *)brought[i] = parts[0];
    });
    return value;
}

inline int lane_group::any(int flag) const { return reduce(*this, int(flag != 0), greater<int>()); }

}  // namespace cooperative_groups

// ---- sorting

namespace cub {

template <class T> struct DoubleBuffer {
    T *d_buffers[2];
    int selector = 0;
    DoubleBuffer(T *current, T *alternate) : d_buffers{current, alternate} {}
    T *Current() { return d_buffers[selector]; }
    T *Alternate() { return d_buffers[1 - selector]; }
};

struct DeviceRadixSort {
    // By the bits from `begin` to `end` of the keys; equal ones keep their order.
    template <class K, class V>
    static void SortPairs(
        void *scratch, size_t &scratch_bytes, DoubleBuffer<K> &keys, DoubleBuffer<V> &values, int64_t count, int begin,
        int end, int /* stream */
    ) {
        scratch_bytes = 1;
        if (!scratch) return;  // the caller asks how much it takes
        uint64_t mask = end - begin >= 64 ? ~0ull : (1ull << (end - begin)) - 1;
        auto bits = [&](int64_t i) { return (uint64_t)keys.Current()[i] >> begin & mask; };
        std::vector<int64_t> order(count);
        std::iota(order.begin(), order.end(), 0);
        std::stable_sort(order.begin(), order.end(), [&](int64_t a, int64_t b) { return bits(a) < bits(b); });
        for (int64_t i = 0; i < count; ++i) {
            keys.Alternate()[i] = keys.Current()[order[i]];
            values.Alternate()[i] = values.Current()[order[i]];
        }
        keys.selector = values.selector = 1 - keys.selector;
    }
};
struct DeviceSegmentedRadixSort {  // not among what the project uses
    template <class... Arguments> static void SortPairs(Arguments &&...) { abort(); }
};

}  // namespace cub

// ---- memory, streams, devices: there is one of each

namespace c10::cuda {
inline int getCurrentCUDAStream() { return 0; }
namespace CUDACachingAllocator {
struct Allocator {
    std::unique_ptr<char[]> allocate(size_t bytes) { return std::make_unique<char[]>(bytes); }
};
inline Allocator *get() {
    static Allocator only;
    return &only;
}
}  // namespace CUDACachingAllocator
}  // namespace c10::cuda

namespace at::cuda {
using c10::cuda::getCurrentCUDAStream;
struct OptionalCUDAGuard {
    template <class Device> explicit OptionalCUDAGuard(Device &&) {}
};
}  // namespace at::cuda

enum cudaError_t { cudaSuccess, cudaErrorInvalidValue };
enum cudaFuncAttribute { cudaFuncAttributeMaxDynamicSharedMemorySize };
template <class Kernel> cudaError_t cudaFuncSetAttribute(Kernel, cudaFuncAttribute, int64_t bytes) {
    return bytes <= 227 * 1024 ? cudaSuccess : cudaErrorInvalidValue;  // an H100's
}

// ---- arithmetic: gsplat is compiled with -use_fast_math; NOISE and STRICT are the other kinds of build.py

namespace emulation {

// CUDA's conversions end at the bounds of the type and make 0 of NaN; in C++ these are undefined.
inline uint32_t to_uint32(double x) { return !(x > 0) ? 0 : x >= UINT32_MAX ? UINT32_MAX : (uint32_t)x; }
inline int32_t to_int32(double x) {
    return x != x ? 0 : x >= INT32_MAX ? INT32_MAX : x <= INT32_MIN ? INT32_MIN : (int32_t)x;
}

#ifdef NOISE
// In [-1, 1], and the same for the same number: forward and backward meet the same error, as they do on a GPU.
inline float noise(float x) {
    uint32_t bits;
    memcpy(&bits, &x, 4);
    bits = (bits ^ bits >> 16) * 0x7feb352du;
    bits = (bits ^ bits >> 15) * 0x846ca68bu;
    return (float)((bits ^ bits >> 16) / 2147483648.0 - 1.0);
}
// What a GPU's tables know of x: its mantissa and, for roots, whether its exponent is odd.
inline float mantissa(float x, bool root) {
    int exponent;
    float digits = frexpf(x, &exponent);
    return root && exponent & 1 ? 2 * digits : digits;
}
// A result that is up to so many units in its last place wrong, by an argument.
inline float rounded(float result, float units, float argument) {
    if (!std::isfinite(result)) return result;
    float unit = nextafterf(fabsf(result), INFINITY) - fabsf(result);
    return result + units * unit * noise(argument);
}
inline float reciprocal(float x) { return rounded(1 / x, 1, mantissa(x, false)); }
inline float root(float x) { return rounded(sqrtf(x), 1, mantissa(x, true)); }
#else
inline float reciprocal(float x) { return 1 / x; }
inline float root(float x) { return sqrtf(x); }
#endif

}  // namespace emulation

#if defined(NOISE)  // the greatest errors that the CUDA programming guide states
inline float __expf(float x) { return emulation::rounded(expf(x), 2 + fabsf(1.173f * x), x); }
inline float __logf(float x) {
    float result = logf(x);
    return x >= 0.5f && x <= 2 ? result + 3.6e-7f * emulation::noise(x) : emulation::rounded(result, 3, x);
}
inline float rsqrtf(float x) { return emulation::rounded(1 / sqrt((double)x), 2, emulation::mantissa(x, true)); }
#elif defined(STRICT)  // as precise as C is
inline float __expf(float x) { return expf(x); }
inline float __logf(float x) { return logf(x); }
inline float rsqrtf(float x) { return 1 / sqrtf(x); }
#else  // in base 2, as nvcc makes them
inline float __expf(float x) { return exp2f(x * 1.4426950408889634f); }
inline float __logf(float x) { return log2f(x) * 0.6931471805599453f; }
inline float rsqrtf(float x) { return 1 / sqrt((double)x); }
#endif
inline float rsqrt(float x) { return rsqrtf(x); }
inline double rsqrt(double x) { return 1 / sqrt(x); }

// Of two types they take the unsigned one; of a number and NaN, the number.
template <class T> concept Integer = std::is_integral_v<T>;
template <Integer A, Integer B> std::common_type_t<A, B> min(A a, B b) {
    using T = std::common_type_t<A, B>;
    return std::min<T>(a, b);
}
template <Integer A, Integer B> std::common_type_t<A, B> max(A a, B b) {
    using T = std::common_type_t<A, B>;
    return std::max<T>(a, b);
}
inline float min(float a, float b) { return fminf(a, b); }
inline float max(float a, float b) { return fmaxf(a, b); }
inline double min(double a, double b) { return fmin(a, b); }
inline double max(double a, double b) { return fmax(a, b); }
