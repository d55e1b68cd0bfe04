// Build information of this module, for benchmarks and reports.
#include <grasp/version.hpp>

#include "module.hpp"

namespace {

// The widest vectors that the compiler may use.
const char* instruction_set() {
#if defined(__AVX512F__) && defined(__AVX512DQ__) && defined(__AVX512VL__)
  return "AVX-512";
#elif defined(__AVX2__) && defined(__FMA__)
  return "AVX2";
#elif defined(__AVX__)
  return "AVX";
#elif defined(__SSE4_2__)
  return "SSE4.2";
#elif defined(__SSE2__)
  return "SSE2";
#elif defined(__ARM_FEATURE_SVE)
  return "SVE";
#elif defined(__ARM_NEON)
  return "NEON";
#else
  return "scalar";
#endif
}

nb::typed<nb::dict, nb::str, nb::str> build_info() {
  nb::dict info;
  info["version"] = GRASP_VERSION;
  info["compiler"] = GRASP_COMPILER;
  info["instruction_set"] = instruction_set();
  info["build_type"] = GRASP_BUILD_TYPE;
  info["arch"] = GRASP_ARCH;
  info["flags"] = GRASP_FLAGS;
  return info;
}

}  // namespace

void bind_build_info(nb::module_& m) {
  m.def(
      "build_info", &build_info,
      "Version, compiler, instruction set, build type, target processor and flags of this module.");
}
