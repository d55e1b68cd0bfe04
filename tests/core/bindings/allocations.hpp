// Counts what is taken from the heap.
#pragma once

extern long allocations;  // since the module was loaded; 0 under the sanitizers, which replace
                          // operator new themselves

// Number of allocations that f makes.
template <class F> long counted(F&& f) {
  const long before = allocations;
  f();
  return allocations - before;
}
