/* Experiment C of the paper, written by hand as a C programmer would: one function, all numbers known beforehand.

   It is the yardstick of benchmarks/handwritten.py, which compares its trajectory with a run's. Three switches set the
   work of a tick: the substeps of the plant, the projections (one for the controller and the hand together, or one for
   each, as the diagram has them), and how much is recorded. Numbers in parentheses are the paper's equations. */

#define _GNU_SOURCE
#include <math.h>
#include <stdint.h>
#include <string.h>

#define TERMS 40

typedef struct {
    int64_t ticks, substeps, projections, terms; /* terms of the sine series of the arc length */
    int64_t record;                              /* 0: nothing; 1: every value of a tick */
    double mean_speed, sines[TERMS];             /* arc length of the ellipse: mean · θ + Σ sines[k] sin 2(k + 1)θ */
    double par[4], par_forcing[2], perp[4], perp_forcing[2]; /* the admittances over one tick */
    double damping[2];                                       /* rendered, N s/m */
    double s[2], v[2], theta[2];                             /* where it starts, where it has come to */
} task;

enum { ROW = 56 };
static const double T = 1e-3, MASS[2] = {7.61 + 29.26, 4.41 + 16.79}, COULOMB[2] = {65.42, 37.69},
                    VISCOUS[2] = {175.93, 62.83}, WEIGHT[2] = {0.0, 9.81 * 4.41}, WIDTH = 0.01, A = 0.3, B = 0.15,
                    CENTER = 0.5, MASS_PAR = 0.5, MASS_PERP = 2.0, STIFFNESS_PERP = 200.0, START = 0.2;

static inline double smooth(double t, double start) {
    double z = (t - start) / 0.2;
    z = z < 0.0 ? 0.0 : z > 1.0 ? 1.0 : z;
    double z4 = z * z * z * z;
    return z4 * (35.0 + z * (-84.0 + z * (70.0 - 20.0 * z)));
}

static inline double pulse(double t, double start, double end, double amplitude) {
    if (t <= start || t >= end) return 0.0;
    return amplitude * (smooth(t, start) - smooth(t, end - 0.2));
}

/* The plant (1), with u + F held. */
static inline double friction(double v, int i) { return COULOMB[i] * tanh(v / WIDTH) + VISCOUS[i] * v; }

static inline double acceleration(double v, double force, int i) { return (force - friction(v, i) - WEIGHT[i]) / MASS[i]; }

static inline void step_plant(double *s, double *v, const double *force, int64_t substeps) {
    const double h = T / (double)substeps;
    for (int64_t k = 0; k < substeps; k++)
        for (int i = 0; i < 2; i++) {
            const double v0 = v[i], a1 = acceleration(v0, force[i], i);
            const double v2 = v0 + 0.5 * h * a1, a2 = acceleration(v2, force[i], i);
            const double v3 = v0 + 0.5 * h * a2, a3 = acceleration(v3, force[i], i);
            const double v4 = v0 + h * a3, a4 = acceleration(v4, force[i], i);
            s[i] += h / 6.0 * (v0 + 2.0 * v2 + 2.0 * v3 + v4);
            v[i] += h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4);
        }
}

/* Foot point: Newton on (6) from the last one, until its step is below the last digits. */
static inline double project(double theta, const double *y, double *c, double *s) {
    for (int k = 0; k < 8; k++) {
        sincos(theta, s, c);
        const double dy = y[0] - CENTER - A * *c, dz = y[1] - CENTER - B * *s;
        const double y1 = -A * *s, z1 = B * *c, y2 = -A * *c, z2 = -B * *s;
        const double change = (dy * y1 + dz * z1) / (y1 * y1 + z1 * z1 - dy * y2 - dz * z2);
        theta += change;
        if (fabs(change) < 1e-9) { /* the rest is its square: cosine and sine follow by their first two terms */
            const double c0 = *c, half = 0.5 * change * change;
            *c -= change * *s + half * *c;
            *s += change * c0 - half * *s;
            break;
        }
    }
    return theta;
}

__attribute__((visibility("default"))) void run_by_hand(task *p, double *rows) {
    double s[2], v[2], a[2] = {0.0, 0.0}, u[2] = {0.0, 0.0}, F[2] = {0.0, 0.0}, drive[2];
    double foot = p->theta[0], hand_foot = p->theta[1];
    double e[2] = {0.0, 0.0}, e_rate[2] = {0.0, 0.0}, integral[2] = {0.0, 0.0};
    memcpy(s, p->s, sizeof s);
    memcpy(v, p->v, sizeof v);
    for (int64_t k = 0; k <= p->ticks; k++) {
        const double t = (double)k * T;
        if (k) {
            for (int i = 0; i < 2; i++) drive[i] = u[i] + F[i];
            step_plant(s, v, drive, p->substeps);
            if (p->record)
                for (int i = 0; i < 2; i++) a[i] = acceleration(v[i], drive[i], i);
        }

        /* Path frame at the foot point, (4) to (7). */
        double c, z;
        foot = project(foot, s, &c, &z);
        const double y1 = -A * z, z1 = B * c, squared = y1 * y1 + z1 * z1, speed = sqrt(squared), inverse = 1.0 / speed;
        const double ty = y1 * inverse, tz = z1 * inverse, ny = -tz, nz = ty;
        const double turning = A * B, stretch = (A * A - B * B) * c * z; /* x′y″ − y′x″ and σ′ᵀσ″; x′y‴ − y′x‴ = 0 */
        const double curvature = turning * inverse * inverse * inverse;
        const double i2 = inverse * inverse, curvature_rate = -3.0 * turning * stretch * i2 * i2 * i2;
        const double xi1 = ny * (s[0] - CENTER - A * c) + nz * (s[1] - CENTER - B * z), q = 1.0 - curvature * xi1;
        const double eta2 = (ty * v[0] + tz * v[1]) / q, xi2 = ny * v[0] + nz * v[1];
        const double s2 = 2.0 * z * c, twice = 2.0 * (c * c - z * z); /* Clenshaw's rule for the arc length (5) */
        double b1 = 0.0, b2 = 0.0;
        for (int64_t j = p->terms - 1; j >= 0; j--) {
            const double b0 = p->sines[j] + twice * b1 - b2;
            b2 = b1;
            b1 = b0;
        }
        const double eta1 = p->mean_speed * foot + s2 * b1;

        /* The hand, which has its own projection where two are asked for. */
        double hy = ty, hz = tz;
        if (p->projections > 1) {
            double hc, hs;
            hand_foot = project(hand_foot, s, &hc, &hs);
            const double r = 1.0 / sqrt(A * A * hs * hs + B * B * hc * hc);
            hy = -A * hs * r;
            hz = B * hc * r;
        }
        const double p1 = pulse(t, 0.5, 1.5, 1.5), p2 = pulse(t, 2.5, 3.5, -1.5), p3 = pulse(t, 8.5, 9.7, 1.5);
        const double p4 = pulse(t, 0.5, 4.5, 0.3), sine = t > 0.5 && t < 4.5 ? sin(6.283185307179586 * t) : 0.0;
        const double p5 = pulse(t, 5.0, 6.0, 6.0), p6 = pulse(t, 6.5, 7.5, -6.0), p7 = pulse(t, 8.5, 9.7, -6.0);
        const double hand_par = p1 + p2 + p3, hand_perp = p4 * sine + p5 + p6 + p7;
        F[0] = hy * hand_par - hz * hand_perp;
        F[1] = hz * hand_par + hy * hand_perp;

        /* Force in the path frame (13), admittance (14), (15), with k∥ = 0. */
        const double f_par = ty * F[0] + tz * F[1], f_perp = ny * F[0] + nz * F[1];
        const double d_par = f_par / MASS_PAR, d_perp = f_perp / MASS_PERP;
        const double a_par = d_par - p->damping[0] * e_rate[0] / MASS_PAR;
        const double a_perp = d_perp - (p->damping[1] * e_rate[1] + STIFFNESS_PERP * e[1]) / MASS_PERP;
        const double eta_p = START + e[0], eta_p_rate = e_rate[0], xi_p = e[1], xi_p_rate = e_rate[1];

        /* Error dynamics (12), feedback linearization (10). */
        const double v_par = a_par - 60.0 * (eta2 - eta_p_rate) - 1200.0 * (eta1 - eta_p) - 8000.0 * integral[0];
        const double v_perp = a_perp - 120.0 * (xi2 - xi_p_rate) - 4800.0 * (xi1 - xi_p) - 64000.0 * integral[1];
        const double along_n = v_perp + curvature * q * eta2 * eta2;
        const double along_t = q * v_par - 2.0 * curvature * eta2 * xi2 - curvature_rate * xi1 * eta2 * eta2;
        u[0] = MASS[0] * (ny * along_n + ty * along_t) + friction(v[0], 0) + WEIGHT[0] - F[0];
        u[1] = MASS[1] * (nz * along_n + tz * along_t) + friction(v[1], 1) + WEIGHT[1] - F[1];

        if (p->record) {
            const double now[ROW + 1] = {
                t, eta1, eta2, eta_p, eta_p_rate, a_par, u[0], u[1], foot, v_par, v_perp, xi1, xi2, xi_p, xi_p_rate,
                a_perp, s[0], s[1], F[0], F[1], v[0], v[1], a[0], a[1], f_par, f_perp, q, p1, p2, p3, p4, p5, p6, p7,
                p1 + p2, hand_par, sine, p4 * sine, p4 * sine + p5, p4 * sine + p5 + p6, hand_perp, START, 0.0, 0.0,
                0.0, 0.0, 0.0, curvature, curvature_rate, e[0], e[1], e_rate[0], e_rate[1], integral[0], integral[1],
                speed, hand_foot,
            };
            memcpy(rows + k * (ROW + 1), now, sizeof now);
        }

        /* Integrals, and the admittance's states at the next tick. */
        integral[0] += T * (eta1 - eta_p);
        integral[1] += T * (xi1 - xi_p);
        const double e0 = e[0], e1 = e[1];
        e[0] = p->par[0] * e0 + p->par[1] * e_rate[0] + p->par_forcing[0] * d_par;
        e_rate[0] = p->par[2] * e0 + p->par[3] * e_rate[0] + p->par_forcing[1] * d_par;
        e[1] = p->perp[0] * e1 + p->perp[1] * e_rate[1] + p->perp_forcing[0] * d_perp;
        e_rate[1] = p->perp[2] * e1 + p->perp[3] * e_rate[1] + p->perp_forcing[1] * d_perp;
    }
    memcpy(p->s, s, sizeof s);
    memcpy(p->v, v, sizeof v);
    p->theta[0] = foot;
    p->theta[1] = hand_foot;
}

#ifdef PROGRAM
#include <stdio.h>
#include <stdlib.h>

int main(int count, char **arguments) {
    task job;
    FILE *file = count > 1 ? fopen(arguments[1], "rb") : NULL;
    if (!file || fread(&job, sizeof job, 1, file) != 1) return 2;
    fclose(file);
    double *rows = calloc((size_t)(job.ticks + 1) * (ROW + 1), sizeof *rows);
    if (!rows) return 2;
    run_by_hand(&job, rows);
    printf("%.17g %.17g\n", job.s[0], job.s[1]);
    free(rows);
    return 0;
}
#endif
