// Counts what is taken from the heap.
#pragma once

extern long allocations;  // since the module was loaded; stays 0 under the sanitizers, which have
                          // an operator new of their own

// Number of allocations that f makes.
template <class F> long counted(F&& f) {
  const long before = allocations;
  f();
  return allocations - before;
}
