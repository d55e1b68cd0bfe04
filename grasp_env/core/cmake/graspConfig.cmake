# grasp::core: C++20 headers without dependencies; grasp::planner: search for grasps (grasp/planner/); grasp::compiled: grasp::core with the
# solvers in a static library. find_package(grasp) reads this file from an installed prefix, a Python package or the source tree;
# add_subdirectory of the folder above includes it.
if(TARGET grasp::core)
  return()
endif()
if(CMAKE_CXX_COMPILER_ID STREQUAL "MSVC")
  message(FATAL_ERROR "grasp uses vector types that MSVC does not have. On Windows build with GCC 11 or Clang 14 under WSL.")
elseif((CMAKE_CXX_COMPILER_ID STREQUAL "GNU" AND CMAKE_CXX_COMPILER_VERSION VERSION_LESS 11)
       OR (CMAKE_CXX_COMPILER_ID MATCHES "Clang" AND CMAKE_CXX_COMPILER_VERSION VERSION_LESS 14))
  message(FATAL_ERROR "grasp needs the C++20 of GCC 11 or Clang 14; this is ${CMAKE_CXX_COMPILER_ID} ${CMAKE_CXX_COMPILER_VERSION}.")
endif()
foreach(beside ../include ../../../include) # in the package; in a prefix, from share/cmake/grasp
  get_filename_component(grasp_include "${CMAKE_CURRENT_LIST_DIR}/${beside}" ABSOLUTE)
  if(EXISTS "${grasp_include}/grasp/version.hpp")
    break()
  endif()
endforeach()
add_library(grasp::core INTERFACE IMPORTED GLOBAL)
# Flags that the headers' speed relies on: fused products and sums, no errno, no floating-point traps. NaN must stay NaN, so never
# -ffast-math. Sources that link grasp::core get these flags too; clear INTERFACE_COMPILE_OPTIONS to use your own. Choose -march
# yourself: with AVX2 or AVX-512, solves take half the time. -Wno-psabi: GCC's notes on passing wide vectors do not apply.
set(grasp_flags -ffp-contract=fast -fno-math-errno -fno-trapping-math -Wno-psabi)
set_target_properties(grasp::core PROPERTIES
  INTERFACE_INCLUDE_DIRECTORIES "${grasp_include}"
  INTERFACE_COMPILE_FEATURES cxx_std_20
  GRASP_FLAGS "${grasp_flags}"
  INTERFACE_COMPILE_OPTIONS "$<$<COMPILE_LANG_AND_ID:CXX,GNU,Clang,AppleClang>:${grasp_flags}>")
add_library(grasp::planner INTERFACE IMPORTED GLOBAL)
set_target_properties(grasp::planner PROPERTIES INTERFACE_LINK_LIBRARIES grasp::core)

# Add a static library of the solvers.
function(grasp_add_library name)
  set(folder "${CMAKE_CURRENT_FUNCTION_LIST_DIR}/../src")
  file(GLOB sources CONFIGURE_DEPENDS "${folder}/*.cpp")
  add_library(${name} STATIC ${sources})
  # less memory for the compiler, at one or two per cent more time
  target_compile_options(${name} PRIVATE $<$<CXX_COMPILER_ID:GNU>:--param=ggc-min-expand=70>)
  # arithmetic with twice the digits is as fast, and compiles in half the time
  set_source_files_properties("${folder}/careful.cpp" PROPERTIES COMPILE_OPTIONS "$<$<NOT:$<CONFIG:Debug>>:-O1>")
  target_link_libraries(${name} PUBLIC grasp::core)
  target_compile_definitions(${name} PUBLIC GRASP_COMPILED) # grasp/optimizer.hpp then leaves the solvers to the library
  set_target_properties(${name} PROPERTIES OUTPUT_NAME grasp POSITION_INDEPENDENT_CODE ON)
endfunction()

# An installed prefix holds the library. Elsewhere a project that links to it compiles it, once, with the project's own flags.
if(EXISTS "${CMAKE_CURRENT_LIST_DIR}/graspCompiled.cmake")
  include("${CMAKE_CURRENT_LIST_DIR}/graspCompiled.cmake")
  set_target_properties(grasp::compiled PROPERTIES IMPORTED_GLOBAL TRUE)
elseif(CMAKE_CXX_COMPILER_LOADED AND EXISTS "${CMAKE_CURRENT_LIST_DIR}/../src")
  grasp_add_library(grasp_compiled)
  set_target_properties(grasp_compiled PROPERTIES EXCLUDE_FROM_ALL TRUE EXPORT_NAME compiled)
  add_library(grasp::compiled ALIAS grasp_compiled)
endif()

string(TOUPPER "${CMAKE_BUILD_TYPE}" grasp_type)
if(CMAKE_CXX_COMPILER_LOADED AND NOT CMAKE_CONFIGURATION_TYPES AND NOT GRASP_PYTHON
   AND NOT "${CMAKE_CXX_FLAGS} ${CMAKE_CXX_FLAGS_${grasp_type}}" MATCHES "-O[123sfz]")
  message(WARNING "grasp: this build is not optimized, solves take twenty times as long (57 us instead of 2.9). "
    "Configure with -DCMAKE_BUILD_TYPE=Release; now it is \"${CMAKE_BUILD_TYPE}\".")
endif()
