// A CUDA device for torch's build for processors: its tensors lie in the processor's memory, the processor computes,
// and what a GPU would refuse is refused. Loaded before torch is imported.
#include <ATen/ATen.h>
#include <ATen/EmptyTensor.h>
#include <ATen/detail/CUDAHooksInterface.h>
#include <ATen/native/transformers/attention.h>
#include <ATen/ops/_reshape_alias_native.h>
#include <ATen/ops/as_strided_native.h>
#include <ATen/ops/view_native.h>
#include <c10/core/Allocator.h>
#include <c10/core/impl/DeviceGuardImplInterface.h>
#include <torch/library.h>

#include <map>
#include <mutex>
#include <set>
#include <string>

namespace {

using at::Tensor;
using c10::Device;
using c10::DeviceIndex;
using c10::DispatchKey;
using c10::IValue;
using c10::SymInt;
using c10::SymIntArrayRef;
using std::optional;

const Device GPU(c10::kCUDA, 0), PROCESSOR(c10::kCPU);

// ---- what is counted

std::mutex counting;
long computed;                      // operations on the device, each at least one launch
std::map<std::string, long> waits;  // for what the processor had to wait until the device was done
std::string told;
size_t held, peak, most = SIZE_MAX;  // bytes

void waited(const std::string &why) {
    std::lock_guard lock(counting);
    ++waits[why];
}
void take(size_t bytes) {
    std::lock_guard lock(counting);
    TORCH_CHECK_WITH(OutOfMemoryError, held + bytes <= most, "CUDA out of memory. Tried to allocate ", bytes, " bytes");
    held += bytes;
    peak = std::max(peak, held);
}
void give_back(size_t bytes) {
    std::lock_guard lock(counting);
    held -= bytes;
}

// ---- memory, device, hooks

struct Block {
    size_t bytes;
    Tensor owner;  // of the numbers, where a kernel for processors made them
    static void release(void *block) {
        give_back(((Block *)block)->bytes);
        if (!((Block *)block)->owner.defined()) free(block);
        else delete (Block *)block;
    }
};

struct Memory final : c10::Allocator {
    c10::DataPtr allocate(size_t bytes) override {
        take(bytes);
        constexpr size_t AHEAD = (sizeof(Block) + 63) / 64 * 64;
        void *block = aligned_alloc(64, AHEAD + (bytes + 63) / 64 * 64);
        new (block) Block{bytes};
        return {(char *)block + AHEAD, block, &Block::release, GPU};
    }
    void copy_data(void *to, const void *from, size_t bytes) const override { memcpy(to, from, bytes); }
};
Memory memory;
const bool allocates = (c10::SetAllocator(c10::kCUDA, &memory), true);

struct Guard final : c10::impl::DeviceGuardImplInterface {
    static constexpr c10::DeviceType static_type = c10::kCUDA;
    static c10::Stream only() { return c10::Stream(c10::Stream::DEFAULT, GPU); }
    Guard() = default;
    explicit Guard(c10::DeviceType) {}
    c10::DeviceType type() const override { return c10::kCUDA; }
    Device exchangeDevice(Device) const override { return GPU; }
    Device getDevice() const override { return GPU; }
    void setDevice(Device) const override {}
    void uncheckedSetDevice(Device) const noexcept override {}
    c10::Stream getStream(Device) const noexcept override { return only(); }
    c10::Stream getDefaultStream(Device) const override { return only(); }
    c10::Stream getNewStream(Device, int) const override { return only(); }
    c10::Stream exchangeStream(c10::Stream) const noexcept override { return only(); }
    DeviceIndex deviceCount() const noexcept override { return 1; }
    void record(void **, const c10::Stream &, DeviceIndex, c10::EventFlag) const override {}
    void block(void *, const c10::Stream &) const override {}
    bool queryEvent(void *) const override { return true; }
    void destroyEvent(void *, DeviceIndex) const noexcept override {}
    bool queryStream(const c10::Stream &) const override { return true; }
    void synchronizeStream(const c10::Stream &) const override {}
    void synchronizeDevice(DeviceIndex) const override {}
    void recordDataPtrOnStream(const c10::DataPtr &, const c10::Stream &) const override {}
};
C10_REGISTER_GUARD_IMPL(CUDA, Guard)

// torch looks for hooks of this name
struct CUDAHooks final : at::CUDAHooksInterface {
    explicit CUDAHooks(at::CUDAHooksArgs) {}
    void init() const override {}
    bool hasCUDA() const override { return true; }
    bool isBuilt() const override { return true; }
    bool isAvailable() const override { return true; }
    bool hasPrimaryContext(DeviceIndex) const override { return true; }
    DeviceIndex deviceCount() const override { return 1; }
    DeviceIndex getCurrentDevice() const override { return 0; }
    void setCurrentDevice(DeviceIndex) const override {}
    DeviceIndex exchangeDevice(DeviceIndex) const override { return 0; }
    DeviceIndex maybeExchangeDevice(DeviceIndex) const override { return 0; }
    Device getDeviceFromPtr(void *) const override { return GPU; }
    c10::Allocator *getPinnedMemoryAllocator() const override { return c10::GetAllocator(c10::kCPU); }
    void deviceSynchronize(DeviceIndex) const override {}
};

// ---- tensors on both sides

Tensor tensor_on(Device device, c10::Storage storage, const Tensor &like) {
    c10::DispatchKeySet key(device == GPU ? DispatchKey::CUDA : DispatchKey::CPU);
    Tensor made = at::detail::make_tensor<c10::TensorImpl>(std::move(storage), key, like.dtype());
    made.unsafeGetTensorImpl()->set_sizes_and_strides(like.sizes(), like.strides(), like.storage_offset());
    return made;
}
c10::Storage storage_of(c10::DataPtr data, size_t bytes) {
    return {c10::Storage::use_byte_size_t(), bytes, std::move(data), nullptr, false};
}
// The numbers of a tensor on the device for kernels of the processor; they live as long as this.
Tensor lent(const Tensor &t) {
    size_t bytes = t.storage().nbytes();
    if (!bytes) return at::empty_strided(t.sizes(), t.strides(), t.options().device(PROCESSOR));
    auto *kept = new Tensor(t);
    c10::DataPtr data(t.storage().mutable_data(), kept, [](void *k) { delete (Tensor *)k; }, PROCESSOR);
    return tensor_on(PROCESSOR, storage_of(std::move(data), bytes), t);
}
// What a kernel of the processor made, as if made on the device.
Tensor adopted(const Tensor &t) {
    size_t bytes = t.storage().nbytes();
    take(bytes);
    auto *block = new Block{bytes, t};
    c10::DataPtr data(t.storage().mutable_data(), block, &Block::release, GPU);
    return tensor_on(GPU, storage_of(std::move(data), bytes), t);
}

// ---- every operation

const std::set<std::string> TELLING{  // the processor has to know a result: a number, or a shape
    "aten::_local_scalar_dense", "aten::nonzero", "aten::masked_select", "aten::equal", "aten::is_nonzero",
    "aten::repeat_interleave", "aten::_unique2", "aten::unique_dim", "aten::unique_consecutive"};
const std::set<std::string> INDEXING{"aten::index", "aten::index_put_", "aten::index_put", "aten::_index_put_impl_"};

// Puts others in the place of all tensors of an argument or a result.
template <class Change> void change_tensors(IValue &value, Change change) {
    if (value.isTensor()) {
        value = change(value.toTensor());
    } else if (value.isTensorList()) {
        auto list = value.toTensorVector();
        for (auto &t : list) t = change(t);
        value = list;
    } else if (value.isOptionalTensorList()) {
        c10::List<optional<Tensor>> list;
        for (const optional<Tensor> &t : value.toOptionalTensorVector()) list.push_back(t ? change(*t) : t);
        value = list;
    }
}

void compute(const c10::OperatorHandle &op, torch::jit::Stack *stack) {
    at::AutoDispatchBelowADInplaceOrView below;
    const std::string &name = op.schema().name();
    std::vector<std::pair<Tensor, Tensor>> pairs;  // on the device, lent
    bool here = false, there = false, masked = false;
    auto lend = [&](const Tensor &t) {
        if (!t.defined()) return t;
        if (!t.is_cuda()) {
            here |= t.dim() > 0;
            return t;
        }
        there = true;
        masked |= t.scalar_type() == at::kBool || t.scalar_type() == at::kByte;
        for (auto &[given, alias] : pairs)
            if (given.is_same(t)) return alias;
        return pairs.emplace_back(t, lent(t)).second;
    };
    size_t count = op.schema().arguments().size();
    for (auto value = stack->end() - count; value != stack->end(); ++value) {
        change_tensors(*value, lend);
        if (value->isDevice() && value->toDevice().is_cuda()) {
            there = true;
            *value = PROCESSOR;
        } else if (value->isGenerator()) {
            TORCH_CHECK(value->toGenerator().device() == GPU, "Expected a 'cuda' device type for generator (", name, ")");
        }
    }
    bool indexing = INDEXING.count(name);  // an index may lie elsewhere, for a copy
    TORCH_CHECK(!here || indexing, "Expected all tensors to be on the same device, but found cuda:0 and cpu (", name, ")");
    if (TELLING.count(name) || (indexing && (here || masked))) waited(name);
    {
        std::lock_guard lock(counting);
        ++computed;
    }
    op.callBoxed(stack);

    for (auto &[given, alias] : pairs) {  // results that were given and grew
        if (given.sizes() == alias.sizes() && given.strides() == alias.strides()) continue;
        Tensor grown = adopted(alias);
        given.unsafeGetTensorImpl()->set_storage_keep_dtype(grown.storage());
        given.unsafeGetTensorImpl()->set_sizes_and_strides(grown.sizes(), grown.strides(), grown.storage_offset());
    }
    auto hand_on = [&](const Tensor &t) -> Tensor {
        if (!t.defined() || !there || !t.is_cpu()) return t;
        for (auto &[given, alias] : pairs) {
            if (alias.is_same(t)) return given;
            if (t.storage().nbytes() && alias.is_alias_of(t)) return tensor_on(GPU, given.storage(), t);
        }
        return adopted(t);
    };
    size_t results = op.schema().returns().size();
    for (auto value = stack->end() - results; value != stack->end(); ++value) change_tensors(*value, hand_on);
}

Tensor empty(SymIntArrayRef size, optional<at::ScalarType> dtype, optional<at::Layout>, optional<Device>,
             optional<bool>, optional<at::MemoryFormat> format) {
    return at::detail::empty_generic(C10_AS_INTARRAYREF_SLOW(size), &memory, c10::DispatchKeySet(DispatchKey::CUDA),
                                     c10::dtype_or_default(dtype), format);
}
Tensor empty_strided(SymIntArrayRef size, SymIntArrayRef strides, optional<at::ScalarType> dtype, optional<at::Layout>,
                     optional<Device>, optional<bool>) {
    return at::detail::empty_strided_generic(C10_AS_INTARRAYREF_SLOW(size), C10_AS_INTARRAYREF_SLOW(strides), &memory,
                                             c10::DispatchKeySet(DispatchKey::CUDA), c10::dtype_or_default(dtype));
}
Tensor as_strided(const Tensor &t, SymIntArrayRef size, SymIntArrayRef strides, optional<SymInt> offset) {
    optional<int64_t> start = offset ? optional(offset->expect_int()) : std::nullopt;
    return at::native::as_strided_tensorimpl(t, C10_AS_INTARRAYREF_SLOW(size), C10_AS_INTARRAYREF_SLOW(strides), start);
}
Tensor view(const Tensor &t, SymIntArrayRef size) { return at::native::view(t, C10_AS_INTARRAYREF_SLOW(size)); }
Tensor reshape_alias(const Tensor &t, SymIntArrayRef size, SymIntArrayRef strides) {
    return at::native::_reshape_alias(t, C10_AS_INTARRAYREF_SLOW(size), C10_AS_INTARRAYREF_SLOW(strides));
}
const Tensor &resize(const Tensor &t, SymIntArrayRef size, optional<at::MemoryFormat>) {
    c10::TensorImpl *made = t.unsafeGetTensorImpl();
    made->set_sizes_contiguous(C10_AS_INTARRAYREF_SLOW(size));
    size_t bytes = (made->numel() + made->storage_offset()) * made->itemsize();
    if (bytes > t.storage().nbytes()) {
        c10::DataPtr data = memory.allocate(bytes);
        memcpy(data.get(), t.storage().data(), t.storage().nbytes());
        t.storage().unsafeGetStorageImpl()->set_data_ptr_noswap(std::move(data));
        t.storage().set_nbytes(bytes);
    }
    return t;
}
// A copy to the device goes on behind the processor's back only from pinned memory; here all of it counts as pinned.
Tensor &copy(Tensor &to, const Tensor &from, bool non_blocking) {
    if (from.is_cuda() && to.is_cuda()) ++computed;
    else if (from.is_cuda() || !non_blocking) waited(from.is_cuda() ? "copy from the device" : "copy to the device");
    at::AutoDispatchBelowADInplaceOrView below;
    (to.is_cuda() ? lent(to) : to).copy_(from.is_cuda() ? lent(from) : from);
    return to;
}

// Attention is one operation on a device, which keeps no scores.
int64_t one_operation(const Tensor &, const Tensor &, const Tensor &, const optional<Tensor> &, double, bool,
                      optional<double>, bool) {
    return int64_t(at::SDPBackend::efficient_attention);
}
std::tuple<Tensor, Tensor, Tensor, Tensor> attend(const Tensor &q, const Tensor &k, const Tensor &v,
                                                  const optional<Tensor> &bias, bool, double, bool causal,
                                                  optional<double> scale) {
    ++computed;
    optional<Tensor> mask = bias ? optional(lent(*bias)) : std::nullopt;
    auto [out, sums] = at::_scaled_dot_product_flash_attention_for_cpu(lent(q), lent(k), lent(v), 0, causal, mask, scale);
    return {adopted(out), adopted(sums), at::empty({}, at::kLong), at::empty({}, at::kLong)};
}
std::tuple<Tensor, Tensor, Tensor, Tensor> attend_backward(
    const Tensor &gradient, const Tensor &q, const Tensor &k, const Tensor &v, const Tensor &bias, const Tensor &out,
    const Tensor &sums, const Tensor &, const Tensor &, double, std::array<bool, 4>, bool causal, optional<double> scale
) {
    ++computed;
    optional<Tensor> mask = bias.defined() ? optional(lent(bias)) : std::nullopt;
    auto [of_q, of_k, of_v] = at::_scaled_dot_product_flash_attention_for_cpu_backward(
        lent(gradient), lent(q), lent(k), lent(v), lent(out), lent(sums), 0, causal, mask, scale);
    return {adopted(of_q), adopted(of_k), adopted(of_v), Tensor()};
}

// Whatever processors have a kernel for, and convolutions, which they would take apart.
const bool registered = [] {
    static std::vector<c10::RegistrationHandleRAII> kept;
    const std::set<std::string> own{"empty.memory_format", "empty_strided", "as_strided", "view", "_reshape_alias",
                                    "resize_", "copy_"};
    auto &dispatcher = c10::Dispatcher::singleton();
    for (const auto &name : dispatcher.getAllOpNames()) {
        auto op = dispatcher.findSchema(name);
        if (!op || name.name.rfind("aten::", 0) || op->hasKernelForDispatchKey(DispatchKey::CUDA)) continue;
        std::string full = toString(name).substr(6);
        bool known = op->hasKernelForDispatchKey(DispatchKey::CPU) || full == "convolution" || full == "convolution_backward";
        if (own.count(full) || !known) continue;
        auto kernel = c10::KernelFunction::makeFromBoxedFunction<&compute>();
        kept.push_back(dispatcher.registerImpl(name, DispatchKey::CUDA, kernel, std::nullopt, nullptr, "emulation"));
    }
    return true;
}();
TORCH_LIBRARY_IMPL(_, CUDA, m) { m.fallback(torch::CppFunction::makeFromBoxedFunction<&compute>()); }
TORCH_LIBRARY_IMPL(aten, CUDA, m) {
    m.impl("empty.memory_format", &empty);
    m.impl("empty_strided", &empty_strided);
    m.impl("as_strided", &as_strided);
    m.impl("view", &view);
    m.impl("_reshape_alias", &reshape_alias);
    m.impl("resize_", &resize);
    m.impl("copy_", &copy);
    m.impl("_scaled_dot_product_efficient_attention", &attend);
    m.impl("_scaled_dot_product_efficient_attention_backward", &attend_backward);
}

}  // namespace

namespace at {
REGISTER_CUDA_HOOKS(CUDAHooks)
namespace native {
REGISTER_CUDA_DISPATCH(_fused_sdp_choice_stub, &one_operation)
}
}  // namespace at

// ---- for tests

extern "C" {
// Lines of "number reason".
__attribute__((visibility("default"))) const char *device_waits() {
    std::lock_guard lock(counting);
    told.clear();
    for (auto &[why, times] : waits) told += std::to_string(times) + " " + why + "\n";
    return told.c_str();
}
__attribute__((visibility("default"))) long device_computed() { return computed; }
__attribute__((visibility("default"))) size_t device_peak() { return peak; }
// Memory that is taken now counts as the highest so far; more than `bytes` there is not.
__attribute__((visibility("default"))) void device_memory(size_t bytes) {
    std::lock_guard lock(counting);
    most = bytes;
    peak = held;
}
}
