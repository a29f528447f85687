/* Radau IIA of order 5 for stiff problems; to be written. */

static int step_radau(method *m) {
    (void)m;
    return FAILED;
}
