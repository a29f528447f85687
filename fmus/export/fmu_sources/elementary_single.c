/* Elementary functions in single precision: sine, cosine, tangent hyperbolic, exponential, exp(x) - 1, logarithm, power.
 *
 * They need IEEE arithmetic in single precision and integers of 64 bits, and compute the same bits on every platform that
 * contracts nothing. None has a loop. Errors are below one unit in the last place (ulp), tanh below 2; tests state the
 * bounds. The methods are those of elementary.c, which see, with fewer terms. The tables are written by elementary_tables.py.
 * LW_NEEDS_..._SINGLE tells which functions are called. */
#include <math.h>
#include <stdint.h>
#include <string.h>
#if defined(__clang__)
#pragma STDC FP_CONTRACT OFF
#elif defined(_MSC_VER)
#pragma fp_contract(off)
#endif

static inline uint32_t lw_bits_single(float x) {
    uint32_t bits;
    memcpy(&bits, &x, sizeof bits);
    return bits;
}

static inline float lw_single(uint32_t bits) {
    float x;
    memcpy(&x, &bits, sizeof x);
    return x;
}

#define LW_SIGN_SINGLE UINT32_C(0x80000000)
#define LW_SHIFT_SINGLE 12582912.0f /* 1.5 · 2^23: added and taken away, it rounds to an integer */

static inline float lw_size_single(float x) { return lw_single(lw_bits_single(x) & ~LW_SIGN_SINGLE); }
static inline float lw_take_sign_single(float x, float of) { return lw_single(lw_bits_single(x) | (lw_bits_single(of) & LW_SIGN_SINGLE)); }
/* 2^e for a normal number */
static inline float lw_power_of_two_single(int32_t e) { return lw_single((uint32_t)(127 + e) << 23); }

/* ---- exp: exp(x) = 2^(k/16) · exp(r) ---- */

#if LW_NEEDS_EXP_SINGLE || LW_NEEDS_EXPM1_SINGLE || LW_NEEDS_POW_SINGLE || LW_NEEDS_TANH_SINGLE
static inline float lw_exp_of_single(float x, float rest) {
    const float rounded = x * LW_INVERSE_STEP_SINGLE + LW_SHIFT_SINGLE, k = rounded - LW_SHIFT_SINGLE;
    const float r = ((x - k * LW_STEP_HI_SINGLE) - k * LW_STEP_LO_SINGLE) + rest;
    const int32_t n = (int32_t)k, i = n & 15, e = (n - i) / 16, first = e / 2;
    const float *row = &lw_exp_table_single[2 * i];
    const float tail = row[1] + (r + r * r * (0.5f + r * (LW_THIRD_SINGLE * 0.5f + r * LW_TWENTY_FOURTH_SINGLE)));
    return ((row[0] + row[0] * tail) * lw_power_of_two_single(first)) * lw_power_of_two_single(e - first);
}

static inline float lw_expf(float x) {
    if (x != x) {
        return x;
    }
    if (x > 88.72284f) {
        return INFINITY;
    }
    return (x < -104.0f) ? 0.0f : lw_exp_of_single(x, 0.0f);
}
#endif

#if LW_NEEDS_EXPM1_SINGLE || LW_NEEDS_TANH_SINGLE
static inline float lw_expm1f(float x) {
    const float a = lw_size_single(x);
    if (a < 0.17f) {
        const float z = x * x, *c = lw_expm1_series_single; /* 1/3!, 1/4!, … */
        if (a < 2e-8f) {
            return x;
        }
        return x + (z * 0.5f + x * z * ((c[0] + x * c[1]) + z * (c[2] + x * (c[3] + x * c[4]))));
    }
    if (x < -18.0f) {
        return -1.0f;
    }
    if (!(x < 40.0f)) {
        return lw_expf(x);
    }
    const float rounded = x * LW_INVERSE_STEP_SINGLE + LW_SHIFT_SINGLE, k = rounded - LW_SHIFT_SINGLE;
    const float r = (x - k * LW_STEP_HI_SINGLE) - k * LW_STEP_LO_SINGLE;
    const int32_t n = (int32_t)k, i = n & 15;
    const float *row = &lw_exp_table_single[2 * i];
    const float s = row[0] * lw_power_of_two_single((n - i) / 16);
    const float tail = row[1] + (r + r * r * (0.5f + r * (LW_THIRD_SINGLE * 0.5f + r * LW_TWENTY_FOURTH_SINGLE)));
    const float hi = s - 1.0f, lo = (s > 1.0f) ? (s - hi) - 1.0f : s - (hi + 1.0f);
    return hi + (lo + s * tail);
}
#endif

/* ---- tanh: an odd series about 0, else by exp(2 x) - 1 ---- */

#if LW_NEEDS_TANH_SINGLE
static inline float lw_tanhf(float x) {
    const float a = lw_size_single(x);
    float y = 1.0f;
    if (x != x) {
        return x;
    }
    if (a < 0.2f) {
        const float z = a * a, *c = lw_tanh_series_single;
        y = a + a * (z * (c[0] + z * (c[1] + z * (c[2] + z * c[3]))));
    } else if (a < 9.1f) {
        const float t = lw_expm1f(2.0f * a);
        y = t / (t + 2.0f);
    } else {
        y = 1.0f;
    }
    return lw_take_sign_single(y, x);
}
#endif

/* ---- log: x = 2^k · m, with 1/m rounded to 9 bits from a table ---- */

#if LW_NEEDS_LOG_SINGLE || LW_NEEDS_POW_SINGLE
#define LW_FIRST_BITS_SINGLE UINT32_C(0x3f350000) /* of about √½, the least m; 1 is in the middle of an interval */

/* The exponent k, the row of the table, and r = m · inverse - 1 as the exact sum of two parts. */
static inline const float *lw_split_single(float x, float *k, float *r1, float *r2) {
    const uint32_t bits = lw_bits_single(x), offset = bits - LW_FIRST_BITS_SINGLE, place = (offset >> 17) & 63u;
    const uint32_t within = offset & UINT32_C(0x7fffff), m = within + LW_FIRST_BITS_SINGLE;
    const float *row = &lw_log_table_single[3u * place];
    const float upper = lw_single(m & UINT32_C(0xfffff000)), lower = lw_single(m) - upper;
    *k = (float)((int32_t)(bits >> 23) - (int32_t)(m >> 23));
    *r1 = upper * row[0] - 1.0f;
    *r2 = lower * row[0];
    return row;
}
#endif

#if LW_NEEDS_LOG_SINGLE
static inline float lw_logf(float x) {
    float k, r1, r2, shift = 0.0f;
    if (!(x > 0.0f)) {
        return (x == 0.0f) ? -INFINITY : ((x != x) ? x : NAN);
    }
    if (x > 3.4028235e38f) {
        return x;
    }
    const float f = x - 1.0f;
    if ((f > -0.03f) && (f < 0.03f)) {
        const float z = f * f;
        return f - (z * 0.5f - f * z * ((LW_THIRD_SINGLE - f * 0.25f) + z * (0.2f - f * (LW_THIRD_SINGLE * 0.5f))));
    }
    if (x < 1.17549435e-38f) {
        x *= 8388608.0f;
        shift = 23.0f;
    }
    const float *row = lw_split_single(x, &k, &r1, &r2);
    k -= shift;
    const float w = k * LW_LOG2_HI_SINGLE + row[1], r = r1 + r2, z = r * r, hi = w + r, lo = (w - hi) + r;
    const float p = (-0.5f + r * LW_THIRD_SINGLE) + z * (-0.25f + r * 0.2f);
    return hi + (lo + ((k * LW_LOG2_LO_SINGLE + row[2]) + (((r1 - r) + r2) + z * p)));
}
#endif

/* ---- pow: exp(y · log x), the logarithm with 10 bits more ---- */

#if LW_NEEDS_POW_SINGLE
static inline float lw_upper_single(float x) { return lw_single(lw_bits_single(x) & UINT32_C(0xfffff000)); }

static inline float lw_powf(float x, float y) {
    const float largest = 3.4028235e38f, b = lw_size_single(y);
    float a = lw_size_single(x), sign = 1.0f, shift = 0.0f, k, r1, r2;
    if ((y == 0.0f) || (x == 1.0f)) {
        return 1.0f;
    }
    if ((x != x) || (y != y)) {
        return x + y;
    }
    if (lw_bits_single(x) & LW_SIGN_SINGLE) {
        /* y is odd, even, or no integer; from 2^24 on all are even */
        const float small = (b < 16777216.0f) ? b : 0.0f;
        const float over = small - (float)((int32_t)small / 2) * 2.0f; /* below 2 */
        if ((over != 0.0f) && (over != 1.0f) && (a != 0.0f) && (a <= largest)) {
            return NAN;
        }
        sign = (over == 1.0f) ? -1.0f : 1.0f;
    }
    if (b > largest) {
        return (a == 1.0f) ? 1.0f : (((a > 1.0f) == (y > 0.0f)) ? INFINITY : 0.0f);
    }
    if ((a == 0.0f) || (a > largest)) {
        return sign * (((a == 0.0f) == (y > 0.0f)) ? 0.0f : INFINITY);
    }
    if (y == 1.0f) {
        return x;
    }
    if (y == 2.0f) {
        return x * x;
    }
    if (b < 1e-10f) {
        return sign;
    }
    if (a < 1.17549435e-38f) {
        a *= 8388608.0f;
        shift = 23.0f;
    }
    const float *row = lw_split_single(a, &k, &r1, &r2);
    k -= shift;
    /* log a = w + r - r²/2 + r³ (1/3 - r/4 + …), as hi + lo */
    const float w = k * LW_LOG2_HI_SINGLE + row[1], r = r1 + r2, r_lo = (r1 - r) + r2;
    const float u = lw_upper_single(r), v = (r - u) + r_lo, z = r * r;
    const float half = 0.5f * u * u, rest = 0.5f * v * (r + u); /* r²/2 = half + rest; half is exact */
    const float s1 = (w == 0.0f) ? r : w + r, e1 = (w == 0.0f) ? 0.0f : (w - s1) + r;
    const float s2 = s1 - half, e2 = (s1 - s2) - half;
    const float p = r * z * ((LW_THIRD_SINGLE - r * 0.25f) + z * (0.2f - r * (LW_THIRD_SINGLE * 0.5f)));
    const float little = ((k * LW_LOG2_LO_SINGLE + row[2]) + (e1 + e2)) + ((r_lo - rest) + p);
    const float hi = s2 + little, lo = (s2 - hi) + little;
    /* y · log a */
    const float l = lw_upper_single(hi), l_rest = lo + (hi - l), yu = lw_upper_single(y);
    if (y * hi > 89.0f) {
        return sign * INFINITY;
    }
    if (y * hi < -104.5f) {
        return sign * 0.0f;
    }
    const float top = yu * l, rest_y = (y - yu) * l + y * l_rest, sum = top + rest_y;
    return sign * lw_exp_of_single(sum, (top - sum) + rest_y);
}
#endif

/* ---- sin and cos: |x| = n π/2 + r, by x · 2/π in integers (Payne and Hanek) ---- */

#if LW_NEEDS_SIN_SINGLE || LW_NEEDS_COS_SINGLE
static inline uint32_t lw_cut_single(uint32_t first, uint32_t shift) {
    const uint64_t both = ((uint64_t)lw_two_over_pi_single[first] << 32) | lw_two_over_pi_single[first + 1u];
    return (uint32_t)((both << shift) >> 32);
}

/* n mod 4, and r in two parts, for a finite a above π/4. */
static inline int32_t lw_reduce_single(float a, float *hi, float *lo) {
    const uint32_t bits = lw_bits_single(a), m = (bits & UINT32_C(0x7fffff)) | UINT32_C(0x800000);
    const uint32_t skip = (bits >> 23) - 120u; /* a = m · 2^e: e - 2 bits, with 32 zeros ahead of 2/π in the table */
    const uint32_t word = skip / 32u, shift = skip % 32u;
    uint64_t p = ((uint64_t)m * lw_cut_single(word + 2u, shift)) >> 32;
    p += (uint64_t)m * lw_cut_single(word + 1u, shift);
    const uint32_t low = (uint32_t)p;
    p = (p >> 32) + (uint64_t)m * lw_cut_single(word, shift);
    uint64_t f = (p << 32) | low; /* x · 2/π in 2^-62, without multiples of 4 */
    const uint64_t n = (f + (UINT64_C(1) << 61)) >> 62;
    f -= n << 62;
    const float sign = (f >> 63) ? -1.0f : 1.0f;
    f = (f >> 63) ? ~f + 1u : f;
    int32_t up = 0;
    if (!(f >> 32)) {
        f <<= 32;
        up += 32;
    }
    if (!(f >> 48)) {
        f <<= 16;
        up += 16;
    }
    if (!(f >> 56)) {
        f <<= 8;
        up += 8;
    }
    if (!(f >> 60)) {
        f <<= 4;
        up += 4;
    }
    if (!(f >> 62)) {
        f <<= 2;
        up += 2;
    }
    /* the first 32 bits as two numbers, times π/2 in two parts */
    const uint32_t q = (uint32_t)(f >> 32);
    const float scale = sign * lw_power_of_two_single(-30 - up);
    const float one = (float)(q & UINT32_C(0xfff00000)) * scale, other = (float)(q & UINT32_C(0xfffff)) * scale;
    const float top = one * LW_HALF_PI_UPPER_SINGLE;
    const float rest = one * LW_HALF_PI_LOWER_SINGLE + other * (LW_HALF_PI_UPPER_SINGLE + LW_HALF_PI_LOWER_SINGLE);
    *hi = top + rest;
    *lo = (top - *hi) + rest;
    return (int32_t)(n & 3u);
}

static inline float lw_turn_single(float x, int32_t quarter) {
    const float a = lw_size_single(x);
    float r = a, lo = 0.0f;
    int32_t n = 0;
    if (!(a <= 3.4028235e38f)) {
        return NAN;
    }
    if (a > 0.7853981f) {
        n = lw_reduce_single(a, &r, &lo);
    }
    const float sign = ((quarter == 0) && (lw_bits_single(x) & LW_SIGN_SINGLE)) ? -1.0f : 1.0f;
    const float z = r * r;
    float y;
    n += quarter;
    if (n & 1) {
        const float *c = lw_cos_series_single, half = 0.5f * z, w = 1.0f - half; /* 1/4!, -1/6!, … */
        y = w + (((1.0f - w) - half) + (z * z * ((c[0] + z * c[1]) + z * z * (c[2] + z * c[3])) - r * lo));
    } else {
        const float *c = lw_sin_series_single; /* -1/3!, 1/5!, … */
        y = r + (z * r * ((c[0] + z * c[1]) + z * z * (c[2] + z * c[3])) + lo * (1.0f - 0.5f * z));
    }
    return (n & 2) ? -sign * y : sign * y;
}
#endif
#if LW_NEEDS_SIN_SINGLE
static inline float lw_sinf(float x) { return (lw_size_single(x) < 2e-4f) ? x : lw_turn_single(x, 0); }
#endif
#if LW_NEEDS_COS_SINGLE
static inline float lw_cosf(float x) { return lw_turn_single(x, 1); }
#endif

/* ---- what compilers call a library for where a processor has no instruction ---- */

#if LW_NEEDS_FLOOR_SINGLE || LW_NEEDS_CEIL_SINGLE
/* x without its fraction; from 2^23 on there is none */
static inline float lw_cut_fraction_single(float x) {
    return (lw_size_single(x) < 8388608.0f) ? lw_take_sign_single((float)(int32_t)x, x) : x;
}
#endif
#if LW_NEEDS_FLOOR_SINGLE
static inline float lw_floorf(float x) {
    const float cut = lw_cut_fraction_single(x);
    return (cut > x) ? cut - 1.0f : cut;
}
#endif
#if LW_NEEDS_CEIL_SINGLE
static inline float lw_ceilf(float x) {
    const float cut = lw_cut_fraction_single(x);
    return (cut < x) ? lw_take_sign_single(cut + 1.0f, x) : cut;
}
#endif
#if LW_NEEDS_FMIN_SINGLE
static inline float lw_fminf(float x, float y) { return ((x <= y) || (y != y)) ? x : y; }
#endif
#if LW_NEEDS_FMAX_SINGLE
static inline float lw_fmaxf(float x, float y) { return ((x >= y) || (y != y)) ? x : y; }
#endif
