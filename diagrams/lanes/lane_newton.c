/* Newton's method over vectors, as in fmus/runtime/newton.c: small systems are solved lane by lane. */

OWN vec largest_of(const vec *values, int n) {
    vec found = splat(0.0);
    for (int i = 0; i < n; i++) found = vec_fmax(found, vec_fabs(values[i]));
    return found;
}

OWN vec length_of(const vec *values, int n) {
    vec sum = splat(0.0);
    for (int i = 0; i < n; i++) sum += values[i] * values[i];
    return vec_sqrt(sum);
}

OWN mask finite_of(const vec *values, int n) {
    mask found = ~(mask){0};
    for (int i = 0; i < n; i++) found &= vec_fabs(values[i]) < INFINITY;
    return found;
}

/* Factorize J of a lane, which is column by column, with partial pivoting; false if a pivot is zero. */
static bool factorize_lane(int n, const vec *J, int lane, double *a, int *rows) {
    for (int i = 0; i < n; i++) {
        rows[i] = i;
        for (int j = 0; j < n; j++) a[i * n + j] = J[j * n + i][lane];
    }
    for (int k = 0; k < n; k++) {
        int best = k;
        for (int i = k + 1; i < n; i++)
            if (fabs(a[i * n + k]) > fabs(a[best * n + k])) best = i;
        if (a[best * n + k] == 0) return false;
        if (best != k) {
            int row = rows[k];
            rows[k] = rows[best];
            rows[best] = row;
            for (int j = 0; j < n; j++) {
                double value = a[k * n + j];
                a[k * n + j] = a[best * n + j];
                a[best * n + j] = value;
            }
        }
        for (int i = k + 1; i < n; i++) {
            double factor = a[i * n + k] /= a[k * n + k];
            for (int j = k + 1; j < n; j++) a[i * n + j] -= factor * a[k * n + j];
        }
    }
    return true;
}

static void substitute_lane(int n, const double *a, const int *rows, const double *given, double *made) {
    for (int i = 0; i < n; i++) {
        made[i] = given[rows[i]];
        for (int j = 0; j < i; j++) made[i] -= a[i * n + j] * made[j];
    }
    for (int i = n - 1; i >= 0; i--) {
        for (int j = i + 1; j < n; j++) made[i] -= a[i * n + j] * made[j];
        made[i] /= a[i * n + i];
    }
}

/* J^-1 r of the lanes that continue; returns where it is found. */
OWN mask newton_direction(int n, const vec *J, const vec *r, vec *direction, mask going) {
    if (n == 1) {
        direction[0] = r[0] / J[0];
        return vec_fabs(direction[0]) < INFINITY;
    }
    mask found = {0};
    EACH_LANE if (going[lane]) {
        double a[n * n], given[n], made[n];
        int rows[n];
        bool good = factorize_lane(n, J, lane, a, rows);
        if (good) {
            for (int i = 0; i < n; i++) given[i] = r[i][lane];
            substitute_lane(n, a, rows, given, made);
            for (int i = 0; i < n; i++) {
                good = good && isfinite(made[i]); /* it may be any number that is not 0 */
                direction[i][lane] = made[i];
            }
        }
        found[lane] = good ? -1 : 0;
    }
    return found;
}

/* Where J is surely regular: the least singular value is at least 1 over the Frobenius norm of the inverse. */
OWN mask are_determined(int n, double singular, const vec *J, mask alive) {
    if (n == 1) return vec_fabs(J[0]) > singular * (1.0 + vec_fabs(J[0] + 1.0));
    mask found = {0};
    EACH_LANE if (alive[lane]) {
        double a[n * n], unit[n], made[n], gain = 0, sum = 0;
        int rows[n];
        for (int i = 0; i < n; i++)
            for (int j = 0; j < n; j++) gain = fmax(gain, fabs(J[j * n + i][lane] + (i == j)));
        bool good = factorize_lane(n, J, lane, a, rows);
        for (int k = 0; good && k < n; k++) {
            for (int i = 0; i < n; i++) unit[i] = i == k;
            substitute_lane(n, a, rows, unit, made);
            for (int i = 0; i < n; i++) sum += made[i] * made[i];
        }
        found[lane] = good && 1 / sqrt(sum) > singular * (1 + gain) ? -1 : 0;
    }
    return found;
}
