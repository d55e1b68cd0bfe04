// Observations: the numbers of several arrays, clipped, as one float32 array.
#include <algorithm>

#include <nanobind/ndarray.h>
#include <nanobind/stl/vector.h>

#include "solution.hpp"

namespace {

class Gather {
 public:
  using Part = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;
  using Bound = nb::ndarray<const float, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

  Gather(std::vector<Part> parts, Bound bound)
      : parts_(std::move(parts)), bound_(std::move(bound)) {
    std::size_t size = 0;
    for (const Part& part : parts_) size += part.size();
    if (bound_.size() != size) throw nb::type_error("expected a float32 bound for each number");
  }
  nb::object operator()() const {
    nb::object row = new_row(npy_intp(bound_.size()), NPY_FLOAT);
    const float* bound = bound_.data();
    float* to = data_of<float>(row.ptr());
    for (const Part& part : parts_)
      for (std::size_t k = 0; k < part.size(); ++k, ++bound, ++to)
        *to = std::min(std::max(float(part.data()[k]), -*bound), *bound);
    return row;
  }

 private:
  std::vector<Part> parts_;
  Bound bound_;
};

}  // namespace

void bind_gather(nb::module_& m) {
  if (_import_array() < 0) throw nb::python_error();
  nb::class_<Gather>(m, "Gather",
                     "Gathers the numbers of several arrays, clipped, into a new float32 array.")
      .def(nb::init<std::vector<Gather::Part>, Gather::Bound>(), "arrays"_a.noconvert(),
           "bound"_a.noconvert(),
           "C-contiguous float64 arrays, read at each call, and a float32 bound for each of their "
           "numbers.")
      .def("__call__", &Gather::operator(),
           nb::sig("def __call__(self) -> numpy.typing.NDArray[numpy.float32]"));
}
