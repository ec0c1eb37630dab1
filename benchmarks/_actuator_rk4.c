/* The actuator's equations under classical RK4 with explicit vectors: what the hardware can do
 * at this scheme, as the yardstick of benchmarks/simulation.py. Compiled by it when a C
 * compiler is there. One block of LANES chromosomes, zero-order-hold inputs. */

#ifndef LANES
#define LANES 8
#endif

typedef double vec __attribute__((vector_size(8 * LANES)));
typedef long long bits __attribute__((vector_size(8 * LANES)));

enum { VM, VB, IM, IB, OMEGA, Z, THETA, STATES };

static inline vec absolute(vec v) { return (vec)((bits)v & 0x7fffffffffffffffLL); }

static inline void derivative(const vec x[STATES], const double u[3], const vec *p,
                              const vec inverse[3], vec d[STATES])
{
    const vec K_dm = p[0], omega_dm = p[1], K_db = p[2], omega_db = p[3], R_m = p[4], K_m = p[6],
              R_b = p[7], B_m = p[10], gamma = p[12], beta = p[13], A = p[14], a0 = p[15],
              a1 = p[16], c0 = p[17], c1 = p[18];
    const vec size = absolute(x[IB]);
    const vec brake = (a0 + a1 * size) * x[Z] + (c0 + c1 * size) * x[OMEGA];
    d[VM] = omega_dm * (K_dm * (0.5 * u[0] - x[IM]) - x[VM]);
    d[VB] = omega_db * (K_db * (0.5 * u[1] - x[IB]) - x[VB]);
    d[IM] = (x[VM] - R_m * x[IM] - K_m * x[OMEGA]) * inverse[0];
    d[IB] = (x[VB] - R_b * x[IB]) * inverse[1];
    d[OMEGA] = (K_m * x[IM] - B_m * x[OMEGA] - brake + u[2]) * inverse[2];
    d[Z] = A * x[OMEGA] - gamma * absolute(x[OMEGA]) * x[Z] - beta * x[OMEGA] * absolute(x[Z]);
    d[THETA] = x[OMEGA];
}

/* u: samples x 3; p: 19 x LANES; sse: 3 x LANES (currents and speed against zero). */
void simulate(const double *u, int samples, const double *parameters, double dt, int steps,
              double *sse)
{
    vec p[19], inverse[3], x[STATES], sum[3];
    for (int i = 0; i < 19; i++)
        for (int l = 0; l < LANES; l++)
            p[i][l] = parameters[i * LANES + l];
    inverse[0] = 1.0 / p[5];
    inverse[1] = 1.0 / p[8];
    inverse[2] = 1.0 / (p[9] + p[11]);
    for (int i = 0; i < STATES; i++)
        x[i] = (vec){0};
    for (int j = 0; j < 3; j++)
        sum[j] = (vec){0};
    const double h = dt / steps;
    for (int k = 0; k < samples; k++) {
        sum[0] += x[IM] * x[IM];
        sum[1] += x[IB] * x[IB];
        sum[2] += x[OMEGA] * x[OMEGA];
        for (int s = 0; s < steps; s++) {
            vec k1[STATES], k2[STATES], k3[STATES], k4[STATES], at[STATES];
            derivative(x, u + 3 * k, p, inverse, k1);
            for (int i = 0; i < STATES; i++) at[i] = x[i] + 0.5 * h * k1[i];
            derivative(at, u + 3 * k, p, inverse, k2);
            for (int i = 0; i < STATES; i++) at[i] = x[i] + 0.5 * h * k2[i];
            derivative(at, u + 3 * k, p, inverse, k3);
            for (int i = 0; i < STATES; i++) at[i] = x[i] + h * k3[i];
            derivative(at, u + 3 * k, p, inverse, k4);
            for (int i = 0; i < STATES; i++)
                x[i] += h / 6.0 * (k1[i] + 2.0 * (k2[i] + k3[i]) + k4[i]);
        }
    }
    for (int j = 0; j < 3; j++)
        for (int l = 0; l < LANES; l++)
            sse[j * LANES + l] = sum[j][l];
}
