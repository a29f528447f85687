/* A communication step within a fused loop: the equations are inlined into each stage of the classical Runge-Kutta method,
 * and inputs and outputs are copied. It comes after stepping.c, without the files of a version of FMI, and works on an
 * instance that the FMU's own library has made from the same sources. Functions that return false have changed nothing:
 * the FMU's own functions then do the step, or say why it fails. */

/* n steps from t0 over `width` into self->next. Inputs, parameters and the memory of the equations are on the stack, where
 * the compiler knows that nothing else changes them. */
static inline bool lw_inline_steps(lw_instance *self, double t0, double width, long n) {
    double u[LW_AT_LEAST_1(LW_N_U)], p[LW_AT_LEAST_1(LW_N_P)], w[LW_AT_LEAST_1(LW_SZ_W)];
    long long int iw[LW_AT_LEAST_1(LW_SZ_IW)];
    const lw_equation e = {self, u, p, iw, w};
    memcpy(u, self->s.values + LW_U, LW_N_U * sizeof(double));
    memcpy(p, self->s.values + LW_P, LW_N_P * sizeof(double));
    return lw_integrate(&e, t0, width, n, false);
}

/* Are these variables of these kinds, with so many values? */
static inline __attribute__((always_inline)) bool lw_are_plain(const uint32_t *references, size_t n, size_t left, bool inputs) {
    for (size_t i = 0; i < n; i++) {
        if (references[i] >= LW_N_VARIABLES) return false;
        const lw_variable *variable = lw_variables + references[i];
        if (inputs ? variable->kind != LW_INPUT || variable->is_discrete
                   : variable->kind == LW_DERIVATIVE || variable->kind == LW_INDICATOR)
            return false;
        if (variable->size > left) return false;
        left -= variable->size;
    }
    return !left;
}

/* Set the inputs, step, and get the outputs. */
static inline __attribute__((always_inline)) bool lw_inline_step(void *instance, const uint32_t *to, size_t n_to, const double *inputs, size_t size_to,
                                  const uint32_t *from, size_t n_from, double *outputs, size_t size_from, double now,
                                  double width) {
    lw_instance *self = instance;
    double *v = self->s.values, end = now + width, t = v[0], u[LW_AT_LEAST_1(LW_N_U)];
    const double tolerance = 1e-12 * fabs(t) + 1e-6 * fabs(width);
    if (LW_N_Z || self->update || self->s.mode != LW_STEPPING || (LW_N_X && v[LW_INTEGRATOR] != LW_RK4)) return false;
#if LW_MOVING_INPUTS
    if (self->s.moving) return false;
#endif
    if (!(isfinite(width) && width > 0.0) || !(fabs(now - t) <= tolerance)) return false;
    if (self->s.stop_time_defined && end > self->s.stop_time + tolerance) return false;
    if (!lw_are_plain(to, n_to, size_to, true) || !lw_are_plain(from, n_from, size_from, false)) return false;
    memcpy(u, v + LW_U, LW_N_U * sizeof(double));
    for (size_t i = 0; i < n_to; i++) {
        const lw_variable *variable = lw_variables + to[i];
        for (uint32_t k = 0; k < variable->size; k++, inputs++) {
            if (!isfinite(*inputs) || *inputs < variable->min || *inputs > variable->max) return false;
            v[variable->first + k] = *inputs;
        }
    }
    const double count = ceil(width / v[LW_STEP] - 1e-9);
    double y[LW_AT_LEAST_1(LW_N_Y)];
    if (!(count <= LW_MAX_SUBSTEPS) || !lw_inline_steps(self, now, width, count < 1.0 ? 1 : (long)count)
        || (LW_N_Y && lw_call(self, lw_output, &end, self->next, v + LW_U, y)) || !lw_are_finite(y, LW_N_Y)) {
        memcpy(v + LW_U, u, LW_N_U * sizeof(double));
        return false;
    }
    memcpy(v + LW_Y, y, LW_N_Y * sizeof(double));
    memcpy(v + LW_X, self->next, LW_N_S * sizeof(double));
    memcpy(v + LW_HELD, v + LW_U, LW_N_U * sizeof(double));
    v[0] = end;
    self->event_found = false;
    self->s.have_outputs = 1;
    self->s.have_derivatives = self->s.have_indicators = 0;
#if LW_MOVING_INPUTS
    self->step_start = now;
    self->s.moved = 0;
#endif
    for (size_t i = 0; i < n_from; i++) {
        const lw_variable *variable = lw_variables + from[i];
        for (uint32_t k = 0; k < variable->size; k++) *outputs++ = v[variable->first + k];
    }
    return true;
}
