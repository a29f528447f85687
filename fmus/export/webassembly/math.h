/* math.h of a WebAssembly module, which has no C library: instructions of the processor, what is exact in a few lines, and
   for the rest the functions of the page's Math, which differ from a C library's by rounding. */
#ifndef LW_MATH_H
#define LW_MATH_H

#include <stdint.h>

#define NAN __builtin_nanf("")
#define INFINITY __builtin_inff()
#define HUGE_VAL __builtin_inf()
#define M_PI 3.14159265358979323846
#define isfinite(x) __builtin_isfinite(x)
#define isnan(x) __builtin_isnan(x)
#define isinf(x) __builtin_isinf(x)
#define signbit(x) __builtin_signbit(x)
#define fabs(x) __builtin_fabs(x)
#define sqrt(x) __builtin_sqrt(x)
#define floor(x) __builtin_floor(x)
#define ceil(x) __builtin_ceil(x)
#define trunc(x) __builtin_trunc(x)
#define rint(x) __builtin_rint(x)
#define nearbyint(x) __builtin_nearbyint(x)
#define copysign(x, y) __builtin_copysign(x, y)

#define LW_EXACT static inline __attribute__((unused))

LW_EXACT double fmin(double x, double y) {
    if (isnan(x)) return y;
    if (isnan(y)) return x;
    return signbit(x) != signbit(y) ? (signbit(x) ? x : y) : x < y ? x : y;
}

LW_EXACT double fmax(double x, double y) {
    if (isnan(x)) return y;
    if (isnan(y)) return x;
    return signbit(x) != signbit(y) ? (signbit(x) ? y : x) : x < y ? y : x;
}

/* x times a power of two, rounded once. */
LW_EXACT double ldexp(double x, int n) {
    while (n > 1000) x *= 0x1p1000, n = n > 3000 ? 2000 : n - 1000;
    while (n < -1000) x *= 0x1p-1000 * 0x1p53, n = n < -3000 ? -2000 : n + 1000 - 53;
    const union { uint64_t bits; double value; } factor = {(uint64_t)(1023 + n) << 52};
    return x * factor.value;
}

LW_EXACT double nextafter(double x, double to) {
    union { double value; uint64_t bits; } u = {x};
    if (isnan(x) || isnan(to)) return x + to;
    if (x == to) return to;
    if (x == 0.0) return copysign(0x1p-1074, to);
    u.bits += (x < to) == (x > 0.0) ? 1 : -1;
    return u.value;
}

/* The rest of x / y with the sign of x: exact, as every difference is. */
LW_EXACT double fmod(double x, double y) {
    double rest = fabs(x), size = fabs(y);
    if (isnan(x) || isnan(y) || isinf(x) || size == 0.0) return NAN;
    while (rest >= size) {
        double part = size;
        while (part <= rest * 0.5) part *= 2.0;
        rest -= part;
    }
    return copysign(rest, x);
}

#define LW_OF_PAGE(name) __attribute__((import_module("math"), import_name(#name))) double name
LW_OF_PAGE(sin)(double);
LW_OF_PAGE(cos)(double);
LW_OF_PAGE(tan)(double);
LW_OF_PAGE(asin)(double);
LW_OF_PAGE(acos)(double);
LW_OF_PAGE(atan)(double);
LW_OF_PAGE(atan2)(double, double);
LW_OF_PAGE(sinh)(double);
LW_OF_PAGE(cosh)(double);
LW_OF_PAGE(tanh)(double);
LW_OF_PAGE(asinh)(double);
LW_OF_PAGE(acosh)(double);
LW_OF_PAGE(atanh)(double);
LW_OF_PAGE(exp)(double);
LW_OF_PAGE(expm1)(double);
LW_OF_PAGE(log)(double);
LW_OF_PAGE(log1p)(double);
LW_OF_PAGE(log2)(double);
LW_OF_PAGE(log10)(double);
LW_OF_PAGE(cbrt)(double);
LW_OF_PAGE(hypot)(double, double);
LW_OF_PAGE(pow)(double, double);
#endif
