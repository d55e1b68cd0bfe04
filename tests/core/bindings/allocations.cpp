// The operator new of this module: it counts. Nothing of _core is touched by it.
#include <vector>

#include "counting.hpp"
#include "module.hpp"

namespace {

struct alignas(64) Wide {
  double numbers[8];
};

// Allocations that the counter must see, through a pointer that the compiler cannot see through.
long known(int vectors) {
  return counted([&] {
    for (int k = 0; k < vectors; ++k) {
      volatile std::size_t size = 3 + k;
      std::vector<double> plain(size);
      std::vector<Wide> wide(size);
      volatile double* kept = plain.data();
      kept[0] = wide[0].numbers[0];
    }
  });
}

}  // namespace

void bind_allocations(nb::module_& m) {
#ifdef GRASP_SANITIZE
  m.attr("counts_allocations") = false;
#else
  m.attr("counts_allocations") = true;
#endif
  m.def("known_allocations", &known, "vectors"_a, "Two for each of these.");
}
