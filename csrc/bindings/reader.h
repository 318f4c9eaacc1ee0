// Reads the keyword arguments of a call into the struct of an operation (ops/arguments.h), with errors by name.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>

#include <cstdint>
#include <cstring>
#include <stdexcept>
#include <string>
#include <tuple>
#include <type_traits>
#include <utility>
#include <vector>

#include "ops/arguments.h"

namespace bt {

namespace nb = nanobind;

// Device of a module's kernels.
struct Device {
  int32_t type;                                       // of DLPack
  const char* name;                                   // for messages
  bool cuda;                                          // takes working memory, and reads rows 16 bytes at a time
  void (*prepare)(void* at, size_t bytes) = nullptr;  // prepares memory that will be written, or null
};

// Reads torch tensors without DLPack, whose capsule costs about 10 us of Python per tensor.
class Torch {
 public:
  // Null until torch is imported.
  static const Torch* get() {
    static const Torch* torch = nullptr;
    if (!torch && nb::borrow<nb::dict>(nb::module_::import_("sys").attr("modules")).contains("torch"))
      torch = new Torch;
    return torch;
  }
  bool is_tensor(nb::handle object) const {
    const PyObject* type = reinterpret_cast<const PyObject*>(Py_TYPE(object.ptr()));
    return type == tensor_ || type == parameter_;
  }
  // Reads address and size of a dense tensor; returns false for any other.
  bool read(nb::handle tensor, nb::dlpack::dtype dtype, int32_t device, void*& at, int64_t& size) const {
    const PyObject* wanted = dtype_of(dtype);
    if (!wanted || nb::steal(PyObject_GetAttr(tensor.ptr(), dtype_)).ptr() != wanted) return false;
    PyObject* here = device == nb::device::cpu::value    ? is_cpu_
                     : device == nb::device::cuda::value ? is_cuda_
                                                         : nullptr;
    if (!here || nb::steal(PyObject_GetAttr(tensor.ptr(), here)).ptr() != Py_True) return false;
    if (call(tensor, is_contiguous_).ptr() != Py_True) return false;
    const nb::object pointer = call(tensor, data_ptr_), count = call(tensor, numel_);
    if (!pointer.is_valid() || !count.is_valid()) return false;
    at = PyLong_AsVoidPtr(pointer.ptr()), size = PyLong_AsLongLong(count.ptr());
    return true;
  }

 private:
  // Kept until the process ends, when Python may be gone.
  Torch() {
    const nb::object torch = nb::module_::import_("torch");
    tensor_ = torch.attr("Tensor").inc_ref().ptr();
    parameter_ = torch.attr("nn").attr("Parameter").inc_ref().ptr();
    const char* names[] = {"float32", "float64", "int32", "int64", "uint8"};
    for (int i = 0; i < kTypes; ++i) types_[i] = torch.attr(names[i]).inc_ref().ptr();
  }
  const PyObject* dtype_of(nb::dlpack::dtype dtype) const {
    const nb::dlpack::dtype known[] = {nb::dtype<float>(), nb::dtype<double>(), nb::dtype<int32_t>(),
                                       nb::dtype<int64_t>(), nb::dtype<uint8_t>()};
    for (int i = 0; i < kTypes; ++i)
      if (dtype == known[i]) return types_[i];
    return nullptr;
  }
  static nb::object call(nb::handle tensor, PyObject* method) {
    nb::object answer = nb::steal(PyObject_CallMethodNoArgs(tensor.ptr(), method));
    if (!answer.is_valid()) PyErr_Clear();  // a tensor without memory
    return answer;
  }
  static constexpr int kTypes = 5;
  PyObject *tensor_, *parameter_, *types_[kTypes];
  PyObject *dtype_ = PyUnicode_InternFromString("dtype"), *is_cpu_ = PyUnicode_InternFromString("is_cpu"),
           *is_cuda_ = PyUnicode_InternFromString("is_cuda"),
           *is_contiguous_ = PyUnicode_InternFromString("is_contiguous"),
           *data_ptr_ = PyUnicode_InternFromString("data_ptr"), *numel_ = PyUnicode_InternFromString("numel");
};

class Reader;
template <class T, class = void> struct IsDescribed : std::false_type {};
template <class T>
struct IsDescribed<T, std::void_t<decltype(std::declval<T&>().fields(std::declval<Reader&>()))>> : std::true_type {};

// nanobind identifies a type by its name across the process: each module has its own namespace.
#if defined(BITYMI_MODULE)
inline namespace of_cpu {
#elif defined(BITYMI_EMULATED)
inline namespace of_emulated {
#else
inline namespace of_cuda {
#endif
// Arguments that are a Python object, with what they point to.
template <class Arguments> struct Held : Arguments {
  std::vector<nb::object> kept;
};
}

class Reader {
 public:
  Reader(std::string function, const nb::kwargs& kwargs, const Device& device)
      : function_(std::move(function)), device_(device) {
    arguments_.reserve(kwargs.size()), kept_.reserve(kwargs.size());
    PyObject *key, *value;
    for (Py_ssize_t at = 0; PyDict_Next(kwargs.ptr(), &at, &key, &value);)
      arguments_.push_back({PyUnicode_AsUTF8(key), value, false});
  }

  bool has(const char* name) const {
    const Argument* found = lookup(name);
    return found && found->value != Py_None;
  }
  template <class T> void array(const char* name, T*& to, int64_t count) {
    int64_t size;
    to = take<T>(name, size, alignof(T));
    expect(name, size, count);
  }
  template <class T> void wide(const char* name, T*& to, int64_t count) {
    int64_t size;
    to = take<T>(name, size, device_.cuda ? 16 : alignof(T));
    expect(name, size, count);
  }
  // An empty array is present but has no address.
  template <class T> void maybe(const char* name, T*& to, int64_t count) {
    static std::remove_const_t<T> nothing;
    to = nullptr;
    if (!has(name)) return;
    array(name, to, count);
    if (!to) to = &nothing;
  }
  template <class T> void rows(const char* name, T*& to, int64_t& n, int width) {
    int64_t size;
    to = take<T>(name, size, alignof(T));
    if (size % width) expect(name, size, (size / width + 1) * width);
    n = size / width;
  }
  template <class T> void work(const char* name, T*& to, int64_t count) {
    to = nullptr;
    if (device_.cuda) array(name, to, count);
  }
  void memory(const char* name, Workspace& to) {
    to = {nullptr, 0};
    if (!device_.cuda) return;
    to.at = take<uint8_t>(name, to.bytes, 16);
  }
  template <class T> void number(const char* name, T& to) {
    std::conditional_t<std::is_floating_point_v<T>, double, T> value = {};
    if (!nb::try_cast(find(name), value)) wrong(name, std::is_same_v<T, bool> ? "a bool" : "a number");
    to = T(value);
  }
  template <class S> void number(const char* name, S (&to)[3]) {
    std::tuple<double, double, double> value;
    if (!nb::try_cast(find(name), value)) wrong(name, "three numbers");
    to[0] = S(std::get<0>(value)), to[1] = S(std::get<1>(value)), to[2] = S(std::get<2>(value));
  }
  // Reads several arguments of one kind: name, target, name, target, ...
  template <class... More> void numbers(const char* name, More&... more) {
    each([this](const char* n, auto& to) { number(n, to); }, name, more...);
  }
  template <class... More> void arrays(int64_t count, const char* name, More&... more) {
    each([&](const char* n, auto& to) { array(n, to, count); }, name, more...);
  }
  template <class... More> void maybes(int64_t count, const char* name, More&... more) {
    each([&](const char* n, auto& to) { maybe(n, to, count); }, name, more...);
  }
  template <size_t kCount> void choice(const char* name, int& to, const char* const (&names)[kCount]) {
    std::string value;
    if (!nb::try_cast(find(name), value)) wrong(name, "a string");
    for (to = 0; to < int(kCount); ++to)
      if (value == names[to]) return;
    refuse(std::string(name) + " cannot be '" + value + "'");
  }
  template <class T> void object(const char* name, T*& to) {
    using Plain = std::remove_const_t<T>;
    std::conditional_t<IsDescribed<Plain>::value, Held<Plain>, Plain>* held = nullptr;
    const nb::handle found = find(name);
    if (!nb::try_cast(found, held) || !held) wrong(name, "an object of this module");
    kept_.push_back(nb::borrow(found));
    to = held;
  }
  template <class T> void maybe_object(const char* name, T*& to) {
    to = nullptr;
    if (has(name)) object(name, to);
  }
  [[noreturn]] void refuse(const std::string& why) const { throw std::invalid_argument(function_ + ": " + why); }

  // Refuses arguments that were not read; None counts as absent.
  void done() const {
    for (const Argument& g : arguments_)
      if (!g.taken && g.value != Py_None)
        throw nb::type_error((function_ + " takes no argument '" + g.name + "'").c_str());
  }
  std::vector<nb::object> keep() { return std::move(kept_); }

 private:
  template <class F, class T, class... More> static void each(const F& fn, const char* name, T& to, More&... more) {
    fn(name, to);
    if constexpr (sizeof...(More) > 0) each(fn, more...);
  }

  // Names as Python stores them; a dictionary would create strings first.
  struct Argument {
    const char* name;
    PyObject* value;
    bool taken;
  };
  const Argument* lookup(const char* name) const {
    for (const Argument& g : arguments_)
      if (!std::strcmp(g.name, name)) return &g;
    return nullptr;
  }
  nb::handle find(const char* name) {
    Argument* found = const_cast<Argument*>(lookup(name));
    if (!found) throw nb::type_error((function_ + " lacks the argument '" + name + "'").c_str());
    found->taken = true;
    return found->value;
  }
  void expect(const char* name, int64_t size, int64_t count) const {
    if (size != count)
      refuse(std::string(name) + " has " + std::to_string(size) + " elements, expected " + std::to_string(count));
  }
  [[noreturn]] void wrong(const char* name, const std::string& wanted) const;

  // torch lacks unsigned integers of 32 and 64 bits
  template <class T>
  using Stored = std::conditional_t<std::is_same_v<T, uint32_t>, int32_t,
                                    std::conditional_t<std::is_same_v<T, uint64_t>, int64_t, T>>;
  template <class T> T* take(const char* name, int64_t& size, size_t alignment) {
    constexpr nb::dlpack::dtype kDtype = nb::dtype<Stored<std::remove_const_t<T>>>();
    const nb::handle object = find(name);
    void* at;
    if (const Torch* torch = Torch::get(); torch && torch->is_tensor(object)) {
      if (!torch->read(object, kDtype, device_.type, at, size)) not_an_array(name, kDtype);
    } else {
      at = take_other<T>(name, object, size);
    }
    kept_.push_back(nb::borrow(object));
    if (reinterpret_cast<uintptr_t>(at) % alignment)
      refuse(std::string(name) + " must start at a multiple of " + std::to_string(alignment) + " bytes");
    if constexpr (!std::is_const_v<T>)
      if (device_.prepare) device_.prepare(at, size_t(size) * sizeof(T));
    return static_cast<T*>(at);
  }
  template <class T> void* take_other(const char* name, nb::handle object, int64_t& size) {
    using Access = std::conditional_t<std::is_const_v<T>, nb::ndarray<nb::ro>, nb::ndarray<>>;
    constexpr nb::dlpack::dtype kDtype = nb::dtype<Stored<std::remove_const_t<T>>>();
    Access a;
    if (!nb::try_cast(object, a, false) || a.device_type() != device_.type || a.dtype() != kDtype || !dense(a))
      not_an_array(name, kDtype);
    size = int64_t(a.size());
    return const_cast<void*>(static_cast<const void*>(a.data()));
  }
  template <class A> static bool dense(const A& a) {
    int64_t step = 1;
    if (a.size() == 0) return true;
    for (size_t i = a.ndim(); i--; step *= int64_t(a.shape(i)))
      if (a.shape(i) != 1 && a.stride(i) != step) return false;
    return true;
  }
  [[noreturn]] void not_an_array(const char* name, nb::dlpack::dtype dtype) const;

  const std::string function_;  // a copy: callers also pass literals
  Device device_;
  std::vector<Argument> arguments_;  // the call keeps the objects alive
  std::vector<nb::object> kept_;
};

inline void Reader::wrong(const char* name, const std::string& wanted) const {
  const nb::handle value = lookup(name)->value;
  std::string is = nb::type_name(value.type()).c_str();
  for (const char* property : {"dtype", "device", "shape"}) {
    const nb::object has = nb::steal(PyObject_GetAttrString(value.ptr(), property));
    if (has)
      is += std::string(", ") + nb::str(has).c_str();
    else
      PyErr_Clear();
  }
  throw nb::type_error((function_ + ": " + name + " must be " + wanted + ", not " + is).c_str());
}
inline void Reader::not_an_array(const char* name, nb::dlpack::dtype dtype) const {
  const char* kind = dtype.code == uint8_t(nb::dlpack::dtype_code::Float) ? "float"
                     : dtype.code == uint8_t(nb::dlpack::dtype_code::Int) ? "int"
                                                                          : "uint";
  wrong(name, std::string("a dense ") + kind + std::to_string(dtype.bits) + " array on " + device_.name);
}

// Reads the arguments of one call.
template <class Arguments> Arguments read(Reader& r) {
  Arguments a = {};
  a.fields(r);
  r.done();
  return a;
}

// Binds a class of arguments shared by several calls; its constructor takes them by keyword.
template <class Arguments>
nb::class_<Held<Arguments>> bind_class(nb::module_& m, const std::string& name, const Device& device, const char* doc) {
  return nb::class_<Held<Arguments>>(m, name.c_str(), doc)
      .def("__init__", [name, device](Held<Arguments>* self, const nb::kwargs& kwargs) {
        Reader r(name, kwargs, device);
        const Arguments a = read<Arguments>(r);
        new (self) Held<Arguments>{a, r.keep()};
      });
}

template <class S> constexpr const char* kSuffix = sizeof(S) == 4 ? "_f32" : "_f64";

}  // namespace bt

// Operations of both devices: templates over the number type in bt and bt::cuda.
#define BT_OPERATIONS(each)                                                                                            \
  each(project_forward) each(project_backward) each(trace_backward) each(blend_forward) each(blend_backward)           \
      each(view_color_forward) each(view_color_backward) each(field_forward) each(field_backward) each(learn_exposure) \
          each(ssim)
