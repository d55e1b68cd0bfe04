// The operator new of this module: it counts. Nothing of _core is touched by it.
#include "allocations.hpp"

#include <cstdlib>
#include <memory>
#include <new>
#include <vector>

#include "module.hpp"

long allocations = 0;

#ifndef GRASP_SANITIZE
void* operator new(std::size_t size) {
    ++allocations;
    if (void* made = std::malloc(size ? size : 1)) return made;
    throw std::bad_alloc();
}
void* operator new(std::size_t size, std::align_val_t align) {
    ++allocations;
    const std::size_t a = std::size_t(align);
    if (void* made = std::aligned_alloc(a, (size + a - 1) / a * a)) return made;
    throw std::bad_alloc();
}
void* operator new[](std::size_t size) { return operator new(size); }
void* operator new[](std::size_t size, std::align_val_t align) { return operator new(size, align); }
void operator delete(void* p) noexcept { std::free(p); }
void operator delete(void* p, std::size_t) noexcept { std::free(p); }
void operator delete(void* p, std::align_val_t) noexcept { std::free(p); }
void operator delete(void* p, std::size_t, std::align_val_t) noexcept { std::free(p); }
void operator delete[](void* p) noexcept { std::free(p); }
void operator delete[](void* p, std::size_t) noexcept { std::free(p); }
void operator delete[](void* p, std::align_val_t) noexcept { std::free(p); }
void operator delete[](void* p, std::size_t, std::align_val_t) noexcept { std::free(p); }
#endif

namespace {

struct alignas(64) Wide { double numbers[8]; };

// What the counter must see: the proof that it counts. Through a pointer that the compiler cannot see through.
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
