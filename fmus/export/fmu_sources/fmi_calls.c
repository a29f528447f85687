/* Functions of FMI: what those of both versions have in common. It comes before the files of one version, which convert its
 * types and name its functions; LW_API is the prefix of these names. */
#if LW_FMI == 2
#define LW_TOKEN_NAME "GUID"
#define LW_CATEGORIES "logStatusWarning, logStatusError and logAll"
#define LW_TAKES_STOP_TIME "fmi2SetupExperiment"
#define LW_USE_CO_SIMULATION "Instantiate it as fmi2CoSimulation"
#define LW_USE_MODEL_EXCHANGE "Instantiate it as fmi2ModelExchange"
#else
#define LW_TOKEN_NAME "instantiation token"
#define LW_CATEGORIES "logStatusWarning and logStatusError"
#define LW_TAKES_STOP_TIME "fmi3EnterInitializationMode"
#define LW_USE_CO_SIMULATION "Use fmi3InstantiateCoSimulation"
#define LW_USE_MODEL_EXCHANGE "Use fmi3InstantiateModelExchange"
#endif

/* ---- logging (FMI 2.0, 2.1.5; FMI 3.0, 2.3.1) ---- */

static const char *lw_category_name(lw_category category) { return category == LW_LOG_ERROR ? "logStatusError" : "logStatusWarning"; }

/* The log categories that a name stands for, as bits; 0: there is none of this name. */
static unsigned lw_categories_of(const char *name) {
    if (!name) return 0;
    if (LW_FMI == 2 && !strcmp(name, "logAll")) return LW_LOG_WARNING | LW_LOG_ERROR;
    for (unsigned category = LW_LOG_WARNING; category <= LW_LOG_ERROR; category <<= 1)
        if (!strcmp(name, lw_category_name((lw_category)category))) return category;
    return 0;
}

/* Choose what is logged: these categories, or all where none is named. False: one is unknown, which has been a warning. */
static bool lw_choose_categories(lw_instance *self, bool on, size_t n, const char *const *names) {
    if (!names) n = 0;
    unsigned chosen = n ? 0 : LW_LOG_WARNING | LW_LOG_ERROR;
    bool all_known = true;
    self->categories = on ? LW_LOG_WARNING | LW_LOG_ERROR : 0; /* for the warnings of this call */
    for (size_t i = 0; i < n; i++) {
        const unsigned found = lw_categories_of(names[i]);
        chosen |= found;
        if (found) continue;
        all_known = false;
        lw_warn(self, LW_API "SetDebugLogging: there is no log category %s, only " LW_CATEGORIES ".", names[i] ? names[i] : "NULL");
    }
    self->categories = on ? chosen : 0;
    return all_known;
}

/* ---- life (FMI 2.0, 2.1.5 and 2.1.6; FMI 3.0, 2.3.1 to 2.3.3) ---- */

static bool lw_is_blank(const char *text) { return !text || text[strspn(text, " \t\r\n")] == 0; }

/* An instance, of which it is checked later whether it may be had: the reason can be logged then. NULL: out of memory. */
static lw_instance *lw_create_named(const char *name, bool model_exchange, bool logging) {
    if (lw_is_blank(name)) name = LW_MODEL_NAME;
    lw_instance *self = lw_create(name, strlen(name));
    if (!self) return NULL;
    self->s.model_exchange = model_exchange;
    self->categories = logging ? LW_LOG_WARNING | LW_LOG_ERROR : 0;
    return self;
}

/* Do the arguments of the instantiation fit this FMU? */
static bool lw_check_instantiation(lw_instance *self, const char *name, const char *token) {
    if (lw_is_blank(name)) return lw_fail(self, "the instance name is empty. Give one.");
    if (!token || strcmp(token, LW_TOKEN))
        return lw_fail(self, "the " LW_TOKEN_NAME " is %s, expected " LW_TOKEN ". The modelDescription.xml that was read doesn't "
                       "belong to this binary: unzip the FMU again.", token ? token : "missing");
    if (LW_LOOP && self->s.model_exchange)
        return lw_fail(self, "this FMU is for Co-Simulation only. " LW_USE_CO_SIMULATION ".");
    return true;
}

static bool lw_terminate(lw_instance *self) {
    if (!lw_is_initialized(self, LW_API "Terminate")) return false;
    self->s.mode = LW_TERMINATED;
    return true;
}

/* ---- stepping (FMI 2.0, 4.2.2; FMI 3.0, 4.2.1) ---- */

/* Does a step from t over h continue where the last one ended, and end in time? */
static inline bool lw_check_step(lw_instance *self, double t, double h) {
    double now = self->s.values[0], tolerance = 1e-12 * fabs(now) + 1e-6 * fabs(h);
    if (!lw_in_mode(self, LW_API "DoStep", LW_STEPPING)) return false;
    if (!(isfinite(h) && h > 0))
        return lw_fail(self, LW_API "DoStep: the communication step is %g s at t = %.9g s, expected a positive number.", h, now);
    if (!(fabs(t - now) <= tolerance))
        return lw_fail(self, LW_API "DoStep: currentCommunicationPoint is %.17g s, but this FMU is at %.17g s. Step from where "
                       "the last step ended, or set an FMU state first.", t, now);
    if (self->s.stop_time_defined && t + h > self->s.stop_time + tolerance)
        return lw_fail(self, LW_API "DoStep: a step of %g s from t = %.9g s passes the stop time of %.9g s. Give a later stopTime "
                       "to " LW_TAKES_STOP_TIME ", or none.", h, t, self->s.stop_time);
    return true;
}

/* ---- Model Exchange (FMI 2.0, 3.2; FMI 3.0, 3.2) ---- */

static bool lw_is_model_exchange(lw_instance *self, const char *function) {
    if (self->s.model_exchange) return true;
    return lw_fail(self, "%s: this is a Co-Simulation instance. " LW_USE_MODEL_EXCHANGE ".", function);
}

/* Is the call allowed, and is the number of values right? */
static bool lw_check_vector(lw_instance *self, const char *function, bool reading, const void *values, size_t found, size_t expected) {
    if (!lw_is_model_exchange(self, function)) return false;
    if (!(reading && lw_is_readable(self)) && !lw_is_initialized(self, function)) return false;
    if (found == expected) return lw_has_lists(self, function, NULL, 0, values, found);
    return lw_fail(self, "%s: found room for %zu values, expected %zu.", function, found, expected);
}

/* Outside of the model's domain the importer may try a shorter step (FMI 2.0, 2.1.3; FMI 3.0, 2.2.3). So an evaluation that
 * has failed in Continuous-Time Mode, the mode before it, is to be discarded, and the instance is not terminated. */
static bool lw_may_try_again(lw_instance *self, int32_t mode) {
    if (mode != LW_CONTINUOUS) return false;
    self->s.mode = mode;
    return true;
}

static bool lw_copy(double *to, const double *from, size_t n) {
    if (n) memcpy(to, from, n * sizeof(double));
    return true;
}

/* ---- states (FMI 2.0, 2.1.8; FMI 3.0, 2.2.6.4) ---- */

static void lw_free_state(void **state) {
    if (!state) return;
    free(*state);
    *state = NULL;
}

static bool lw_get_serialized_size(lw_instance *self, const char *function, size_t *size) {
    if (!lw_has_room(self, function, size)) return false;
    *size = LW_SERIALIZED;
    return true;
}
