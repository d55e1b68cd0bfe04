# grasp::core: C++20 headers without dependencies; grasp::planner: where a hand can hold an object (grasp/planner/). This one file is what find_package(grasp) reads, in an installed prefix, in a
# Python package or in the source tree, and what add_subdirectory of the folder above gives.
if(TARGET grasp::core)
  return()
endif()
foreach(beside ../include ../../../include) # in the package; in a prefix, from share/cmake/grasp
  get_filename_component(grasp_include "${CMAKE_CURRENT_LIST_DIR}/${beside}" ABSOLUTE)
  if(EXISTS "${grasp_include}/grasp/version.hpp")
    break()
  endif()
endforeach()
add_library(grasp::core INTERFACE IMPORTED GLOBAL)
# What the headers were made fast with: products and sums rounded at once, no errno and no traps of the floating point. Numbers
# that are none stay none: never -ffast-math. Your own sources that link grasp::core get these too; who wants their own clears
# INTERFACE_COMPILE_OPTIONS. -march is yours to choose: with AVX2 or AVX-512 solves take half the time. -Wno-psabi: GCC's notes
# on passing wide vectors concern nobody here.
set(grasp_flags -ffp-contract=fast -fno-math-errno -fno-trapping-math -Wno-psabi)
set_target_properties(grasp::core PROPERTIES
  INTERFACE_INCLUDE_DIRECTORIES "${grasp_include}"
  INTERFACE_COMPILE_FEATURES cxx_std_20
  GRASP_FLAGS "${grasp_flags}"
  INTERFACE_COMPILE_OPTIONS "$<$<COMPILE_LANG_AND_ID:CXX,GNU,Clang,AppleClang>:${grasp_flags}>")
add_library(grasp::planner INTERFACE IMPORTED GLOBAL)
set_target_properties(grasp::planner PROPERTIES INTERFACE_LINK_LIBRARIES grasp::core)

string(TOUPPER "${CMAKE_BUILD_TYPE}" grasp_type)
if(CMAKE_CXX_COMPILER_LOADED AND NOT CMAKE_CONFIGURATION_TYPES AND NOT GRASP_PYTHON
   AND NOT "${CMAKE_CXX_FLAGS} ${CMAKE_CXX_FLAGS_${grasp_type}}" MATCHES "-O[123sfz]")
  message(WARNING "grasp: this build is not optimized, solves take twenty times as long (57 us instead of 2.9). "
    "Configure with -DCMAKE_BUILD_TYPE=Release; now it is \"${CMAKE_BUILD_TYPE}\".")
endif()
