// The residual field's parameters as an object of Python.
#pragma once

#include <nanobind/stl/tuple.h>

#include <tuple>

#include "bindings/arrays.h"
#include "core/field.h"

namespace bt {

// The kernels' view of the field's parameters, arrays of the device D; keeps them alive. The table starts at a multiple
// of kAlignment bytes.
template <class S, class D, int kAlignment>
struct FieldHandle {
  using In = nb::ndarray<const S, nb::c_contig, D>;
  using Out = nb::ndarray<S, nb::c_contig, D>;

  FieldArrays<S> arrays;
  In table, w1, w2, w3;

  FieldHandle(In table_, In w1_, In w2_, In w3_, int levels, int log2_size, int min_resolution, bool contract,
              std::tuple<double, double, double> mid, double half)
      : table(table_), w1(w1_), w2(w2_), w3(w3_) {
    if (levels < 1 || levels > kMaxLevels || log2_size < 1 || log2_size > 28)
      throw std::invalid_argument("a field has 1 to 4 levels and 2 to 2^28 entries per level");
    arrays = {levels,
              log2_size,
              min_resolution,
              contract,
              {S(std::get<0>(mid)), S(std::get<1>(mid)), S(std::get<2>(mid))},
              S(half),
              aligned(table.data()),
              data(w1, levels * kFeatures * kWidth, "w1"),
              data(w2, kWidth * kWidth, "w2"),
              data(w3, kWidth * 3, "w3")};
    data(table, entries(), "table");
  }
  int64_t entries() const { return arrays.table_size(); }
  FieldGradients<S> gradients(const Out& dtable, const Out& dw1, const Out& dw2, const Out& dw3) const {
    aligned(dtable.data());
    return {data(dtable, entries(), "dtable"), data(dw1, arrays.levels * kFeatures * kWidth, "dw1"),
            data(dw2, kWidth * kWidth, "dw2"), data(dw3, kWidth * 3, "dw3")};
  }

 private:
  static const S* aligned(const S* table) {
    if (reinterpret_cast<uintptr_t>(table) % kAlignment)
      throw std::invalid_argument("the field's table must start at a multiple of " + std::to_string(kAlignment) +
                                  " bytes");
    return table;
  }
};

template <class F>
void bind_field_class(nb::module_& m, const std::string& name) {
  using namespace nb::literals;
  using In = typename F::In;
  nb::class_<F>(m, name.c_str())
      .def(nb::init<In, In, In, In, int, int, int, bool, std::tuple<double, double, double>, double>(),
           "table"_a.noconvert(), "w1"_a.noconvert(), "w2"_a.noconvert(), "w3"_a.noconvert(), "levels"_a, "log2_size"_a,
           "min_resolution"_a, "contract"_a, "mid"_a, "half"_a);
}

}  // namespace bt
