// Level of x86-64, 1 to 4, that this processor and its system support. Built for the oldest level,
// to choose among builds for later ones. Uses cpuid directly, since not every compiler's library
// supports __builtin_cpu_supports.
#include <cpuid.h>

#define BIT(word, n) ((word) >> (n) & 1u)

extern "C" int grasp_processor_level() {
  unsigned a, b, c, d, more_b, more_c, high, state = 0;
  if (!__get_cpuid(1, &a, &b, &c, &d)) return 1;
  unsigned extended_a, extended_b, extended_c = 0;
  if (!__get_cpuid(0x80000001u, &extended_a, &extended_b, &extended_c, &more_c)) return 1;
  // SSE3, SSSE3, SSE4.1, SSE4.2
  const unsigned sse = BIT(c, 0) & BIT(c, 9) & BIT(c, 19) & BIT(c, 20);
  if (!(sse & BIT(c, 13) & BIT(c, 23) & BIT(extended_c, 0))) return 1;  // CMPXCHG16B, POPCNT, LAHF
  if (!(BIT(c, 27) & BIT(c, 28) && __get_cpuid_count(7, 0, &a, &more_b, &more_c, &d))) return 2;
  __asm__("xgetbv" : "=a"(state), "=d"(high) : "c"(0));  // registers that the system saves
  // AVX2, FMA, F16C, MOVBE
  const unsigned avx2 = BIT(more_b, 5) & BIT(c, 12) & BIT(c, 29) & BIT(c, 22);
  if ((state & 0x06) != 0x06 || !(avx2 & BIT(more_b, 3) & BIT(more_b, 8) & BIT(extended_c, 5)))
    return 2;  // BMI1, BMI2, LZCNT
  const unsigned avx512 =
      BIT(more_b, 16) & BIT(more_b, 17) & BIT(more_b, 28) & BIT(more_b, 30) & BIT(more_b, 31);
  return (state & 0xe0) == 0xe0 && avx512 ? 4 : 3;
}
