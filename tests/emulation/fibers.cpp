// Fibers of one block, and the meetings between them.
#include "emulation.h"

#include <setjmp.h>
#include <ucontext.h>
#include <xmmintrin.h>

namespace emulation {

namespace {

constexpr unsigned MOST_THREADS = 1024;
constexpr size_t STACK_BYTES = 64 * 1024;

struct Thread : Place {
    bool alive = false, waits = false;
    uint32_t lanes;  // whom it waits for
    void *brought;
    Combine combine;

    std::unique_ptr<char[]> stack;  // none before its first block
    ucontext_t entry;
    jmp_buf pause;
};

std::vector<Thread> threads(MOST_THREADS);
Thread *current;    // what `here` is a part of
jmp_buf scheduler;  // where fibers return to
const std::function<void()> *kernel;

// A fiber: one thread of a block, then one of the next.
void live() {
    for (;;) {
        (*kernel)();
        current->alive = false;
        if (!_setjmp(current->pause)) _longjmp(scheduler, 1);
    }
}

void give_stack(Thread &thread) {
    thread.stack.reset(new char[STACK_BYTES]);
    getcontext(&thread.entry);
    thread.entry.uc_stack.ss_sp = thread.stack.get();
    thread.entry.uc_stack.ss_size = STACK_BYTES;
    makecontext(&thread.entry, live, 0);
}

// Until it waits or ends.
void resume(Thread &thread) {
    here = current = &thread;
    if (_setjmp(scheduler)) return;
    if (thread.stack) _longjmp(thread.pause, 1);
    give_stack(thread);
    setcontext(&thread.entry);
}

// Lets the set that this thread waits for go on, if all of it that lives waits for the same; says whether it did.
bool let_meet(Thread &thread) {
    Thread *members[MOST_THREADS];
    void *brought[MOST_THREADS];
    unsigned count = 0;
    bool whole = thread.lanes == WHOLE_BLOCK;
    unsigned first = whole ? 0 : thread.rank - thread.lane();
    unsigned end = std::min(block.threads, whole ? MOST_THREADS : first + WARP);
    for (unsigned rank = first; rank < end; ++rank) {
        Thread &other = threads[rank];
        if (!other.alive || !(whole || thread.lanes >> other.lane() & 1)) continue;
        if (!other.waits || other.lanes != thread.lanes || other.combine != thread.combine) return false;
        members[count] = &other;
        brought[count++] = other.brought;
    }
    thread.combine(brought, count);
    for (unsigned i = 0; i < count; ++i) members[i]->waits = false;
    return true;
}

void run_block() {
    for (unsigned rank = 0; rank < block.threads; ++rank) {
        Thread &thread = threads[rank];
        unsigned row = rank / block.size.x;
        thread.index = {rank % block.size.x, row % block.size.y, row / block.size.y};
        thread.rank = rank;
        thread.alive = true;
        thread.waits = false;
    }
    for (bool goes_on = true; goes_on;) {
        for (unsigned rank = 0; rank < block.threads; ++rank)
            if (threads[rank].alive) resume(threads[rank]);
        goes_on = false;
        bool lives = false;
        for (unsigned rank = 0; rank < block.threads; ++rank) {
            lives |= threads[rank].alive;
            if (threads[rank].alive && threads[rank].waits) goes_on |= let_meet(threads[rank]);
        }
        if (lives && !goes_on) {
            fprintf(stderr, "emulation: the threads of a block wait for each other for ever\n");
            abort();
        }
    }
}

}  // namespace

Block block;
const Place *here;
long launches = 0;

void meet(uint32_t lanes, void *brought, Combine combine) {
    current->lanes = lanes;
    current->brought = brought;
    current->combine = combine;
    current->waits = true;
    while (current->waits)
        if (!_setjmp(current->pause)) _longjmp(scheduler, 1);
}

void run_grid(dim3 grid, dim3 size, size_t shared_bytes, const std::function<void()> &body) {
    ++launches;
    std::vector<char> shared(shared_bytes);
    block = {grid, size, {}, size.x * size.y * size.z, shared.data()};
    if (block.threads == 0 || block.threads > MOST_THREADS) {
        fprintf(stderr, "emulation: %u threads in a block\n", block.threads);
        abort();
    }
    kernel = &body;

    unsigned mode = _mm_getcsr();
#ifndef STRICT
    _mm_setcsr(mode | 0x8040);  // numbers too small for the normal form are zero
#endif

    // In a mixed order: what blocks add up atomically has no order on a GPU either.
    std::vector<unsigned> order((size_t)grid.x * grid.y * grid.z);
    std::iota(order.begin(), order.end(), 0);
    for (size_t i = order.size(); i > 1; --i) std::swap(order[i - 1], order[rand() % i]);
    for (unsigned at : order) {
        block.index = {at % grid.x, at / grid.x % grid.y, at / grid.x / grid.y};
        std::fill(shared.begin(), shared.end(), char(0xff));  // floats that nobody wrote are NaN
        run_block();
    }
    _mm_setcsr(mode);
}

}  // namespace emulation
