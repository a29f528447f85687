/* Sine, cosine and tangent hyperbolic of a fused run: elementary.c's tables and series without a branch, so that the compiler
 * goes over several of them at a time. Errors are some units in the last place of 1; sine and cosine hold below
 * LW_FAST_LIMIT and are left to elementary.c beyond. They come after elementary.c in one unit. */
#define LW_FAST_LIMIT 0x1p20

#if LW_NEEDS_TANH
static inline __attribute__((always_inline)) double lw_fast_tanh(double x) {
    double a = lw_double(lw_bits(x) & ~LW_SIGN);
    a = a < 19.0 ? a : 19.0; /* beyond, it is 1 */
    double s = a * 16.0 + LW_SHIFT, d = a - (s - LW_SHIFT) * 0.0625, d2 = d * d, d4 = d2 * d2;
    const double *c = lw_tanh_table + 12 * (size_t)(uint32_t)lw_bits(s);
    double p = ((c[3] + d * c[4]) + d2 * (c[5] + d * c[6])) + d4 * ((c[7] + d * c[8]) + d2 * (c[9] + d * c[10]));
    double y = lw_take_sign(c[0] + ((d + d * c[2]) + d2 * p), x);
    return x == x ? y : x;
}
#endif

#if LW_NEEDS_SIN || LW_NEEDS_COS
static inline __attribute__((always_inline)) double lw_fast_turn(double x, int quarter) {
    double s = x * 0.6366197723675814 + LW_SHIFT, n = s - LW_SHIFT;
    double r = (x - n * LW_HALF_PI_1) - n * LW_HALF_PI_SECOND, z = r * r, z2 = z * z, z4 = z2 * z2;
    const double *a = lw_sin_series, *b = lw_cos_series;
    double sine = r + z * r * (((a[0] + z * a[1]) + z2 * (a[2] + z * a[3])) + z4 * ((a[4] + z * a[5]) + z2 * a[6]));
    double cosine = (1.0 - 0.5 * z)
                    + z2 * (((b[0] + z * b[1]) + z2 * (b[2] + z * b[3])) + z4 * ((b[4] + z * b[5]) + z2 * b[6]));
    uint64_t turns = lw_bits(s) + (uint64_t)quarter;
    return lw_double(lw_bits(turns & 1 ? cosine : sine) ^ (turns & 2) << 62);
}
static inline double lw_fast_sin(double x) { return lw_fast_turn(x, 0); }
static inline double lw_fast_cos(double x) { return lw_fast_turn(x, 1); }
static inline double lw_any_sin(double x) { return fabs(x) < LW_FAST_LIMIT ? lw_fast_turn(x, 0) : lw_turn(x, 0); }
static inline double lw_any_cos(double x) { return fabs(x) < LW_FAST_LIMIT ? lw_fast_turn(x, 1) : lw_turn(x, 1); }
#endif
