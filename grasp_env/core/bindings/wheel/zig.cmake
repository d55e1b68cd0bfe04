# The C++ compiler of PyPI's ziglang (Clang with its own libc++ and the symbols of any glibc), wrapped as separate programs for CMake.
# zig is taken from the PATH or from the environment of the target Python, which an isolated build hides only from `import`.
find_package(Python 3.10 COMPONENTS Interpreter REQUIRED)
execute_process(COMMAND "${Python_EXECUTABLE}" -c "import sysconfig; print(sysconfig.get_path('platlib'))"
  OUTPUT_STRIP_TRAILING_WHITESPACE OUTPUT_VARIABLE packages COMMAND_ERROR_IS_FATAL ANY)
find_program(zig zig HINTS "${packages}/ziglang" NO_CACHE)
if(zig)
  set(found "${zig}")
  if(NOT GRASP_ZIG)
    set_property(CACHE GRASP_ZIG PROPERTY VALUE native) # keep this choice
  endif()
  foreach(tool IN ITEMS "CXX_COMPILER=c++ -target ${GRASP_ZIG}" AR=ar RANLIB=ranlib)
    string(REGEX MATCH "^([A-Z_]+)=(.*)$" tool "${tool}")
    set(program "${PROJECT_BINARY_DIR}/zig/${CMAKE_MATCH_1}")
    file(WRITE "${program}" "#!/bin/sh\nexec \"${zig}\" ${CMAKE_MATCH_2} \"$@\"\n")
    file(CHMOD "${program}" PERMISSIONS OWNER_READ OWNER_WRITE OWNER_EXECUTE)
    set(CMAKE_${CMAKE_MATCH_1} "${program}" CACHE FILEPATH "of ziglang" FORCE)
  endforeach()
  message(STATUS "Compiler: ${zig}, whose first use takes a minute")
endif()
