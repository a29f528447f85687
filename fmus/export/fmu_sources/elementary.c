/* Elementary functions of exported FMUs: sine, cosine, tangent hyperbolic, exponential, exp(x) - 1, logarithm, power.
 *
 * They need nothing of the platform but IEEE arithmetic in double precision, so that an FMU computes the same bits
 * everywhere; the platform's own functions differ in their last bits. They are short rather than few in instructions:
 * an integrator waits for one after the other. Errors are below one unit in the last place (ulp); tests state the bounds.
 * The tables are written by elementary_tables.py, which the generated file includes before this one. LW_NEEDS_... tells
 * which functions the equations call. */
#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <string.h>
#if defined(__clang__)
#pragma STDC FP_CONTRACT OFF /* a fused multiply-add rounds otherwise, where the processor has one */
#elif defined(_MSC_VER)
#pragma fp_contract(off)
#endif

static inline uint64_t lw_bits(double x) {
    uint64_t bits;
    memcpy(&bits, &x, sizeof bits);
    return bits;
}

static inline double lw_double(uint64_t bits) {
    double x;
    memcpy(&x, &bits, sizeof x);
    return x;
}

#define LW_SIGN (UINT64_C(1) << 63)
#define LW_SHIFT 6755399441055744.0 /* 1.5 · 2^52: added and taken away, it rounds to an integer */

static inline double lw_take_sign(double x, double of) { return lw_double(lw_bits(x) | (lw_bits(of) & LW_SIGN)); }

/* ---- tanh: Taylor series about the nearest of the points i/16 ---- */

#if LW_NEEDS_TANH
static inline double lw_tanh(double x) {
    double a = lw_double(lw_bits(x) & ~LW_SIGN), y;
    if (a < 0.15625) { /* an odd series: of x + x³ p, the rounding of x³ p hardly counts */
        double z = a * a, z2 = z * z;
        const double *c = lw_tanh_series;
        double p = (c[0] + z * c[1]) + z2 * ((c[2] + z * c[3]) + z2 * ((c[4] + z * c[5]) + z2 * (c[6] + z * c[7])));
        y = a + a * z * p;
    } else if (a < LW_TANH_END) {
        int i = (int)(a * 16.0 + 0.5);
        const double *c = lw_tanh_table + 12 * (size_t)i, d = a - (double)i * 0.0625, d2 = d * d, d4 = d2 * d2;
        double p = ((c[3] + d * c[4]) + d2 * (c[5] + d * c[6]))
                   + d4 * (((c[7] + d * c[8]) + d2 * (c[9] + d * c[10])) + d4 * c[11]);
        y = c[0] + (d + (c[1] + (d * c[2] + d2 * p))); /* the slope is 1 - tanh²: d as it is, and c[2] = -tanh² */
    } else if (a == a) {
        y = 1.0;
    } else {
        return x;
    }
    return lw_take_sign(y, x);
}
#endif

/* ---- exp: exp(x) = 2^(k/128) · exp(r) ---- */

#if LW_NEEDS_EXP || LW_NEEDS_EXPM1 || LW_NEEDS_POW
/* 2^(k/128) · (1 + tail + r + r²/2 + …) from x + rest; what is beyond the range of exponents goes by two steps. */
static inline double lw_scale_power(double hi, double lo, int64_t k) {
    int64_t e = k >> 7;
    if (e > -1000 && e < 1000) return hi + lo; /* the exponent is in hi and lo already */
    /* they have 2^0 to 2^(127/128) only */
    if (e >= 0) return (hi + lo) * lw_double((uint64_t)(1023 + e / 2) << 52) * lw_double((uint64_t)(1023 + e - e / 2) << 52);
    return (hi + lo) * lw_double((uint64_t)(1023 + e + 600) << 52) * 0x1p-600;
}

static inline double lw_exp_of(double x, double rest) {
    double rounded = x * (128.0 * 1.4426950408889634) + LW_SHIFT, k = rounded - LW_SHIFT;
    double r = ((x - k * LW_LN2_HI) - k * LW_LN2_LO) + rest, r2 = r * r;
    int64_t n = (int64_t)k, e = n >> 7;
    const double *row = lw_exp_table + 2 * (size_t)(n & 127);
    double tail = (row[1] + r) + (r2 * (0.5 + r * (1.0 / 6.0)) + r2 * r2 * (1.0 / 24.0 + r * (1.0 / 120.0)));
    double s = e > -1000 && e < 1000 ? lw_double(lw_bits(row[0]) + ((uint64_t)e << 52)) : row[0];
    return lw_scale_power(s, s * tail, n);
}

static inline double lw_exp(double x) {
    if (!(x < 709.8)) return x != x ? x : x > 709.782712893384 ? INFINITY : lw_exp_of(x, 0.0);
    if (x < -745.2) return 0.0;
    return lw_exp_of(x, 0.0);
}
#endif

#if LW_NEEDS_EXPM1
static inline double lw_expm1(double x) {
    double a = lw_double(lw_bits(x) & ~LW_SIGN);
    if (a < 0.17) {
        double z = x * x;
        const double *c = lw_expm1_series; /* 1/3!, 1/4!, … */
        double p = ((c[0] + x * c[1]) + z * (c[2] + x * c[3])) + z * z * ((c[4] + x * c[5]) + z * (c[6] + x * (c[7] + x * c[8])));
        if (a < 0x1p-54) return x;
        return x + (z * 0.5 + x * z * p);
    }
    if (x < -40.0) return -1.0;
    if (!(x < 60.0)) return lw_exp(x);
    double rounded = x * (128.0 * 1.4426950408889634) + LW_SHIFT, k = rounded - LW_SHIFT;
    double r = (x - k * LW_LN2_HI) - k * LW_LN2_LO, r2 = r * r;
    int64_t n = (int64_t)k;
    const double *row = lw_exp_table + 2 * (size_t)(n & 127);
    double s = lw_double(lw_bits(row[0]) + ((uint64_t)(n >> 7) << 52));
    double tail = (row[1] + r) + (r2 * (0.5 + r * (1.0 / 6.0)) + r2 * r2 * (1.0 / 24.0 + r * (1.0 / 120.0)));
    double hi = s - 1.0, lo = s > 1.0 ? (s - hi) - 1.0 : s - (hi + 1.0);
    return hi + (lo + s * tail);
}
#endif

/* ---- log: x = 2^k · m, with 1/m rounded to 9 bits from a table ---- */

#if LW_NEEDS_LOG || LW_NEEDS_POW
#define LW_FIRST_BITS UINT64_C(0x3fe6b00000000000) /* of about √½, the least m; 1 is in the middle of an interval */

/* The exponent k, the row of the table, and r = m · inverse - 1 as the exact sum of two parts. */
static inline const double *lw_split(double x, double *k, double *r1, double *r2) {
    uint64_t bits = lw_bits(x), offset = bits - LW_FIRST_BITS;
    int64_t e = (int64_t)offset >> 52;
    uint64_t m = bits - ((uint64_t)e << 52);
    const double *row = lw_log_table + 3 * (size_t)((offset >> 45) & 127);
    double upper = lw_double(m & UINT64_C(0xffffffff00000000)), lower = lw_double(m) - upper;
    *k = (double)e;
    *r1 = upper * row[0] - 1.0;
    *r2 = lower * row[0];
    return row;
}
#endif

#if LW_NEEDS_LOG
static inline double lw_log(double x) {
    double k, r1, r2, shift = 0.0;
    if (!(x > 0.0)) return x == 0.0 ? -INFINITY : x != x ? x : NAN;
    if (x == INFINITY) return x;
    double f = x - 1.0;
    if (f > -0.02 && f < 0.02) {
        double z = f * f, z2 = z * z;
        const double *c = lw_log_series; /* 1/3, -1/4, … */
        double p = ((c[0] + f * c[1]) + z * (c[2] + f * c[3])) + z2 * ((c[4] + f * c[5]) + z * (c[6] + f * c[7]));
        return f - (z * 0.5 - f * z * p);
    }
    if (x < 0x1p-1022) x *= 0x1p54, shift = 54.0;
    const double *row = lw_split(x, &k, &r1, &r2);
    k -= shift;
    double w = k * LW_LOG2_HI + row[1], r = r1 + r2, z = r * r;
    double hi = w + r, lo = (w - hi) + r;
    double p = (-0.5 + r * (1.0 / 3.0)) + z * ((-0.25 + r * 0.2) + z * (-1.0 / 6.0 + r * (1.0 / 7.0)));
    return hi + (lo + (k * LW_LOG2_LO + row[2] + ((r1 - r) + r2) + z * p));
}
#endif

/* ---- pow: exp(y · log x), the logarithm with 15 bits more ---- */

#if LW_NEEDS_POW
static inline double lw_upper(double x) { return lw_double(lw_bits(x) & UINT64_C(0xfffffffff8000000)); }

/* 0: y is no integer; 1: odd; 2: even */
static inline int lw_parity(double y) {
    double a = lw_double(lw_bits(y) & ~LW_SIGN);
    if (a >= 0x1p53) return 2;
    int64_t n = (int64_t)a;
    return (double)n != a ? 0 : n & 1 ? 1 : 2;
}

static inline double lw_pow(double x, double y) {
    if (y == 0.0 || x == 1.0) return 1.0;
    if (x != x || y != y) return x + y;
    double sign = 1.0, shift = 0.0, a = lw_double(lw_bits(x) & ~LW_SIGN), b = lw_double(lw_bits(y) & ~LW_SIGN);
    if (lw_bits(x) & LW_SIGN) {
        int parity = lw_parity(y);
        if (!parity && a != 0.0 && a != INFINITY && b != INFINITY) return NAN;
        if (parity == 1) sign = -1.0;
    }
    if (b == INFINITY) return a == 1.0 ? 1.0 : (a > 1.0) == (y > 0.0) ? INFINITY : 0.0;
    if (a == 0.0 || a == INFINITY) return sign * ((a == 0.0) == (y > 0.0) ? 0.0 : INFINITY);
    if (y == 1.0) return x;
    if (y == 2.0) return x * x;
    if (b < 0x1p-65) return 1.0;
    if (a < 0x1p-1022) a *= 0x1p54, shift = 54.0;
    double k, r1, r2;
    const double *row = lw_split(a, &k, &r1, &r2);
    k -= shift;
    /* log a = w + r - r²/2 + r³ (1/3 - r/4 + …), as hi + lo */
    double w = k * LW_LOG2_HI + row[1], r = r1 + r2, r_lo = (r1 - r) + r2, u = lw_upper(r), v = (r - u) + r_lo;
    double half = 0.5 * u * u, rest = 0.5 * v * (r + u), z = r * r; /* r²/2 = half + rest; half is exact */
    double s1 = w + r, e1 = (w - s1) + r;
    if (w == 0.0) s1 = r, e1 = 0.0;
    double s2 = s1 - half, e2 = (s1 - s2) - half;
    double p = r * z * ((1.0 / 3.0 + r * -0.25) + z * ((0.2 + r * (-1.0 / 6.0)) + z * (1.0 / 7.0 + r * -0.125)));
    double small = ((k * LW_LOG2_LO + row[2]) + (e1 + e2)) + (r_lo - rest) + p;
    double hi = s2 + small, lo = (s2 - hi) + small;
    /* y · log a */
    double l = lw_upper(hi), l_rest = lo + (hi - l), yu = lw_upper(y);
    if (y * hi > 709.9) return sign * INFINITY;
    if (y * hi < -745.3) return sign * 0.0;
    double top = yu * l, rest_y = (y - yu) * l + y * l_rest;
    double sum = top + rest_y;
    if (sum > 709.79) return sign * INFINITY;
    return sign * lw_exp_of(sum, (top - sum) + rest_y);
}
#endif

/* ---- sin and cos: x = n π/2 + r ---- */

#if LW_NEEDS_SIN || LW_NEEDS_COS
/* 64 bits of a long number, whose lowest word comes first, from a bit on. */
static inline uint64_t lw_cut(const uint32_t *words, int from) {
    const uint32_t *w = words + from / 32;
    int shift = from % 32;
    uint64_t low = (uint64_t)w[1] << 32 | w[0];
    return shift ? low >> shift | (uint64_t)w[2] << (64 - shift) : low;
}

/* n mod 4, and r in two parts, for a finite |x| of 2^20 or more: x · 2/π by integers (Payne and Hanek). */
static int lw_reduce_large(double x, double *hi, double *lo) {
    uint64_t bits = lw_bits(x), m = (bits & UINT64_C(0xfffffffffffff)) | UINT64_C(1) << 52;
    int e = (int)(bits >> 52 & 2047) - 1075;   /* |x| = m · 2^e */
    int first = e >= 34 ? (e - 2) / 32 : 0;    /* words of 2/π before this one make multiples of 4 */
    int point = 224 + 32 * first - e;          /* the bit of the product with seven words that counts 1 */
    uint32_t product[12] = {0};
    for (int half = 0; half < 2; half++) {
        uint64_t factor = half ? m >> 32 : m & UINT64_C(0xffffffff), carry = 0;
        for (int i = 0; i < 8; i++) {
            uint64_t word = i < 7 ? lw_two_over_pi[first + 6 - i] : 0;
            carry += word * factor + product[i + half];
            product[i + half] = (uint32_t)carry;
            carry >>= 32;
        }
    }
    int n = (int)(lw_cut(product, point) & 3);
    uint64_t f1 = lw_cut(product, point - 64), f2 = lw_cut(product, point - 128); /* the fraction, in 2^-64 and 2^-128 */
    bool negative = f1 >> 63;
    if (negative) n++, f2 = ~f2 + 1, f1 = ~f1 + (f2 == 0); /* to within half a quarter turn */
    int up = 0;
    while (up < 100 && !(f1 >> 63)) f1 = f1 << 1 | f2 >> 63, f2 <<= 1, up++;
    /* the fraction as two doubles, the first of 27 bits, times π/2 */
    double scale = lw_double((uint64_t)(1023 - 64 - up) << 52);
    double a = (double)(f1 >> 37) * 0x1p37 * scale;
    double b = ((double)(f1 & ((UINT64_C(1) << 37) - 1)) + (double)(f2 >> 11) * 0x1p-53) * scale;
    double top = a * LW_HALF_PI_UPPER, low = a * LW_HALF_PI_LOWER + b * (LW_HALF_PI_UPPER + LW_HALF_PI_LOWER);
    *hi = top + low;
    *lo = (top - *hi) + low;
    if (negative) *hi = -*hi, *lo = -*lo;
    if (bits & LW_SIGN) n = -n, *hi = -*hi, *lo = -*lo;
    return n & 3;
}

static inline int lw_reduce(double x, double *hi, double *lo) {
    double a = lw_double(lw_bits(x) & ~LW_SIGN);
    if (a <= 0.7853981633974483) return *hi = x, *lo = 0.0, 0;
    if (a >= 0x1p20) return lw_reduce_large(x, hi, lo);
    double n = (x * 0.6366197723675814 + LW_SHIFT) - LW_SHIFT, r = x - n * LW_HALF_PI_1; /* exact */
    if (a < 1600.0) { /* n < 2^10: two parts do, unless x is near n π/2 */
        double w = n * LW_HALF_PI_SECOND, s = r - w;
        if (s > 0x1p-10 || s < -0x1p-10) return *hi = s, *lo = (r - s) - w, (int)((int64_t)n & 3);
    }
    double w = n * LW_HALF_PI_2; /* exact */
    double s = r - w, t = s - r, e = (r - (s - t)) - (w + t);
    double v = n * LW_HALF_PI_3, s2 = s - v, t2 = s2 - s, e2 = (s - (s2 - t2)) - (v + t2);
    double rest = (e + e2) - n * LW_HALF_PI_4;
    *hi = s2 + rest;
    *lo = (s2 - *hi) + rest;
    return (int)((int64_t)n & 3);
}

static inline double lw_sin_near(double r, double lo) {
    double z = r * r, z2 = z * z;
    const double *c = lw_sin_series; /* -1/3!, 1/5!, … */
    double p = (c[1] + z * c[2]) + z2 * ((c[3] + z * c[4]) + z2 * (c[5] + z * (c[6] + z * c[7])));
    return r + (z * r * (c[0] + z * p) + lo * (1.0 - 0.5 * z));
}

static inline double lw_cos_near(double r, double lo) {
    double z = r * r, z2 = z * z, half = 0.5 * z, w = 1.0 - half;
    const double *c = lw_cos_series; /* 1/4!, -1/6!, … */
    double p = (c[0] + z * c[1]) + z2 * ((c[2] + z * c[3]) + z2 * ((c[4] + z * c[5]) + z2 * (c[6] + z * c[7])));
    return w + (((1.0 - w) - half) + (z2 * p - r * lo));
}

static inline double lw_turn(double x, int quarter) {
    double r, lo;
    double a = lw_double(lw_bits(x) & ~LW_SIGN);
    if (!(a < INFINITY)) return NAN;
    if (!quarter && a < 0x1p-27) return x;
    int n = lw_reduce(x, &r, &lo) + quarter;
    double y = n & 1 ? lw_cos_near(r, lo) : lw_sin_near(r, lo);
    return n & 2 ? -y : y;
}
#endif
#if LW_NEEDS_SIN
static inline double lw_sin(double x) { return lw_turn(x, 0); }
#endif
#if LW_NEEDS_COS
static inline double lw_cos(double x) { return lw_turn(x, 1); }
#endif
