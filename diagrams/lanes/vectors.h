/* Vectors of LANES numbers, one of each run, and functions of them without branches between lanes.

   What a lane holds depends on nothing in another one. Sums of a product are fused where one expression holds both and
   the processor can. The errors of the functions are stated in docs/howto/sweeps.md and tested. */

#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <string.h>
#if defined(_WIN32)
#define VISIBLE __declspec(dllexport)
#else
#define VISIBLE __attribute__((visibility("default")))
#endif

typedef double vec __attribute__((vector_size(8 * LANES)));
typedef int64_t mask __attribute__((vector_size(8 * LANES))); /* all bits of an entry are set where it is true */
typedef uint64_t bits __attribute__((vector_size(8 * LANES)));

#define INLINE static inline __attribute__((always_inline))
#define OWN static inline
#define AT_LEAST_1(n) ((n) > 0 ? (n) : 1)
#define EACH_LANE for (int lane = 0; lane < LANES; lane++)

INLINE vec splat(double x) { return x - (vec){0}; } /* keeps the sign of a zero */
INLINE vec where(mask m, vec x) { return (vec)(m & (mask)x); }
INLINE vec one_where(mask m) { return where(m, splat(1.0)); }
INLINE vec choose(mask m, vec x, vec y) { return (vec)((m & (mask)x) | (~m & (mask)y)); }
INLINE bool any(mask m) {
    int64_t found = 0;
    EACH_LANE found |= m[lane];
    return found != 0;
}
INLINE mask sign_of(vec x) { return (mask)x & INT64_MIN; }
INLINE vec vec_fabs(vec x) { return (vec)((mask)x & INT64_MAX); }
#if defined(__clang__)
#if __has_builtin(__builtin_elementwise_copysign)
#define COPIES_SIGNS
#endif
#endif
#if defined(COPIES_SIGNS)
/* LLVM 18 and 19 merge the bits of the other form wrongly for AVX-512: their floor of 2.5 was 5.6e-309. */
INLINE vec vec_copysign(vec x, vec y) { return __builtin_elementwise_copysign(x, y); }
#else
INLINE vec vec_copysign(vec x, vec y) { return (vec)(((mask)x & INT64_MAX) | sign_of(y)); }
#endif
INLINE vec vec_sign(vec x) { return choose(x < 0.0, splat(-1.0), choose(x > 0.0, splat(1.0), x)); }
/* Of a NaN and a number, the number, as in C. */
INLINE vec vec_fmin(vec x, vec y) { return choose((x < y) | (y != y), x, y); }
INLINE vec vec_fmax(vec x, vec y) { return choose((x > y) | (y != y), x, y); }

#define SHIFT 6755399441055744.0 /* 1.5 · 2^52: added and taken away, it rounds to an integer */
INLINE vec round_near(vec x) { return (x + SHIFT) - SHIFT; }
INLINE vec vec_floor(vec x) {
    vec r = round_near(x);
    r = r - one_where(r > x);
    return choose(vec_fabs(x) < 0x1p51, vec_copysign(r, x), x);
}
INLINE vec vec_ceil(vec x) { return -vec_floor(-x); }

#define ONE_BY_ONE(name) \
    OWN vec vec_##name(vec x) { \
        vec y; \
        EACH_LANE y[lane] = name(x[lane]); \
        return y; \
    }
#define TWO_BY_TWO(name) \
    OWN vec vec_##name(vec x, vec y) { \
        vec z; \
        EACH_LANE z[lane] = name(x[lane], y[lane]); \
        return z; \
    }
ONE_BY_ONE(tan)
ONE_BY_ONE(asin)
ONE_BY_ONE(acos)
ONE_BY_ONE(atan)
ONE_BY_ONE(sinh)
ONE_BY_ONE(cosh)
ONE_BY_ONE(asinh)
ONE_BY_ONE(acosh)
ONE_BY_ONE(atanh)
ONE_BY_ONE(log1p)
ONE_BY_ONE(erf)
TWO_BY_TWO(atan2)
TWO_BY_TWO(hypot)
TWO_BY_TWO(pow)
TWO_BY_TWO(fmod)
TWO_BY_TWO(remainder)
#if defined(__clang__)
INLINE vec vec_sqrt(vec x) { return __builtin_elementwise_sqrt(x); }
#else
ONE_BY_ONE(sqrt)
#endif

/* ---- exp and exp(x) - 1: x = k ln 2 + r ---- */

#define LOG2_E 1.4426950408889634
#define LN2_HI 0x1.62e42fefa0000p-1
#define LN2_LO 0x1.cf79abc9e3b3ap-40

/* k as a number and as bits; r, of at most half of ln 2 */
INLINE vec split_power(vec x, vec *k, bits *shifted) {
    vec moved = x * LOG2_E + SHIFT;
    *shifted = (bits)moved;
    *k = moved - SHIFT;
    return (x - *k * LN2_HI) - *k * LN2_LO;
}

/* exp(r) - 1 for a small r, by its series; r²/2 is exact enough to stand alone */
INLINE vec series_expm1(vec r) {
    vec z = r * r, z2 = z * z, z4 = z2 * z2;
    vec p0 = (1.0 / 6.0) + r * (1.0 / 24.0), p1 = (1.0 / 120.0) + r * (1.0 / 720.0);
    vec p2 = (1.0 / 5040.0) + r * (1.0 / 40320.0), p3 = (1.0 / 362880.0) + r * (1.0 / 3628800.0);
    vec p4 = (1.0 / 39916800.0) + r * (1.0 / 479001600.0), p5 = splat(1.0 / 6227020800.0);
    vec low = p0 + z * p1, high = p2 + z * p3, top = p4 + z * p5;
    vec p = (low + z2 * high) + z4 * top;
    return r + (z * 0.5 + (z * r) * p);
}

/* 2^k for |k| below 1022, from the bits of k + SHIFT */
INLINE vec power_of(bits shifted) { return (vec)((shifted + 1023) << 52); }

INLINE vec vec_exp(vec x) {
    vec k, y = choose(x > 720.0, splat(720.0), choose(x < -760.0, splat(-760.0), x)); /* a NaN stays one */
    bits shifted;
    vec r = split_power(y, &k, &shifted);
    vec half = round_near(k * 0.5), rest = k - half;
    vec scale = power_of((bits)(half + SHIFT)), more = power_of((bits)(rest + SHIFT));
    return (1.0 + series_expm1(r)) * scale * more;
}

INLINE vec vec_expm1(vec x) {
    vec k, y = choose(x > 720.0, splat(720.0), choose(x < -60.0, splat(-60.0), x));
    bits shifted;
    vec r = split_power(y, &k, &shifted);
    vec half = round_near(k * 0.5), rest = k - half;
    vec scale = power_of((bits)(half + SHIFT)), more = power_of((bits)(rest + SHIFT));
    vec e = series_expm1(r);
    /* (2^k e + 2^k - 1), with 2^half apart so that large ones don't overflow early */
    vec small = 1.0 / more;
    vec found = ((scale - small) + scale * e) * more;
    return choose(x == 0.0, x, found);
}

/* ---- tanh = (e - 1) / (e + 1) with e = exp(2 |x|) ---- */

INLINE vec vec_tanh(vec x) {
    vec a = vec_fabs(x), k;
    a = choose(a > 22.0, splat(22.0), a);
    bits shifted;
    vec r = split_power(a + a, &k, &shifted), scale = power_of(shifted);
    vec e = series_expm1(r) * scale + (scale - 1.0);
    return vec_copysign(e / (e + 2.0), x);
}

/* ---- log: x = 2^k m, m between √½ and √2; log m = 2 artanh((m - 1) / (m + 1)) ---- */

INLINE vec vec_log(vec x) {
    mask tiny = x < 0x1p-1022;
    vec scaled = choose(tiny, x * 0x1p54, x);
    bits all = (bits)scaled, offset = all - UINT64_C(0x3fe6a09e667f3bcd);
    mask e = (mask)offset >> 52;
    vec m = (vec)(all - ((bits)e << 52));
    vec k = (vec)((bits)(e + INT64_C(0x4338000000000000))) - SHIFT; /* e as a number: the bits of SHIFT + e */
    k = k - where(tiny, splat(54.0));
    vec f = m - 1.0, s = f / (2.0 + f), z = s * s, w = z * z;
    vec p = w * (0x1.999999997fa04p-2 + w * (0x1.c71c51d8e78afp-3 + w * 0x1.39a09d078c69fp-3));
    vec q = z * (0x1.5555555555593p-1 + w * (0x1.2492494229359p-2 + w * (0x1.7466496cb03dep-3 + w * 0x1.2f112df3e5244p-3)));
    vec half = 0.5 * f * f, tail = s * (half + (p + q)) + k * LN2_LO;
    vec y = k * LN2_HI - ((half - tail) - f);
    y = choose(x == INFINITY, x, y);
    y = choose(x == 0.0, splat(-INFINITY), y);
    return choose((x < 0.0) | (x != x), splat(NAN), y);
}

/* ---- sine and cosine: x = n π/2 + r ---- */

#define PIO2_1 1.57079632673412561417e+00 /* 33 bits each, so that products with n below 2^20 are exact */
#define PIO2_2 6.07710050630396597660e-11
#define PIO2_3 2.02226624871116645580e-21
#define PIO2_REST 8.47842766036889956997e-32

INLINE vec turn(vec x, int quarter) {
    vec moved = x * 0.6366197723675814 + SHIFT, n = moved - SHIFT;
    vec w1 = n * PIO2_1, w2 = n * PIO2_2, w3 = n * PIO2_3;
    vec r = x - w1;
    vec s = r - w2, t = s - r, e = (r - (s - t)) - (w2 + t);
    vec s2 = s - w3, t2 = s2 - s, e2 = (s - (s2 - t2)) - (w3 + t2);
    vec rest = (e + e2) - n * PIO2_REST;
    vec hi = s2 + rest, lo = (s2 - hi) + rest;
    vec z = hi * hi, z2 = z * z, z4 = z2 * z2;
    vec sines = ((8.33333333332248946124e-03 + z * -1.98412698298579493134e-04) +
                 z2 * (2.75573137070700676789e-06 + z * -2.50507602534068634195e-08)) + z4 * 1.58969099521155010221e-10;
    vec cosines = ((4.16666666666666019037e-02 + z * -1.38888888888741095749e-03) +
                   z2 * (2.48015872894767294178e-05 + z * -2.75573143513906633035e-07)) +
                  z4 * (2.08757232129817482790e-09 + z * -1.13596475577881948265e-11);
    vec v = z * hi;
    vec sine = hi - ((z * (0.5 * lo - v * sines) - lo) - v * -1.66666666666666324348e-01);
    vec half = 0.5 * z, top = 1.0 - half;
    vec cosine = top + (((1.0 - top) - half) + (z2 * cosines - hi * lo));
    bits q = (bits)moved + (uint64_t)quarter;
    mask odd = -(mask)(q & 1);
    return (vec)((mask)choose(odd, cosine, sine) ^ (mask)((q & 2) << 62));
}

static __attribute__((noinline)) vec turn_far(vec x, vec y, int quarter) {
    EACH_LANE if (!(fabs(x[lane]) < 0x1p20)) y[lane] = quarter ? cos(x[lane]) : sin(x[lane]);
    return y;
}

INLINE vec vec_sin(vec x) {
    vec y = turn(x, 0);
    y = choose(vec_fabs(x) < 0x1p-27, x, y);
    mask far = vec_fabs(x) >= 0x1p20;
    return __builtin_expect(any(far), 0) ? turn_far(x, y, 0) : y;
}
INLINE vec vec_cos(vec x) {
    vec y = turn(x, 1);
    mask far = vec_fabs(x) >= 0x1p20;
    return __builtin_expect(any(far), 0) ? turn_far(x, y, 1) : y;
}
