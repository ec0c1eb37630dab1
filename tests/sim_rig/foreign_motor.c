/* A motor on a shaft, FMI 2.0 co-simulation, by its closed solution. Angles in degrees. */
#include <math.h>
#include <stddef.h>
#include <stdlib.h>

typedef struct { double volts, gain, tau, angle, speed; } Motor;

static double *place(Motor *m, unsigned r)
{
    double *all[] = {&m->volts, &m->gain, &m->tau, &m->angle, &m->speed};
    return r < 5 ? all[r] : NULL;
}

const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }

void *fmi2Instantiate(const char *name, int type, const char *guid, const char *where,
    const void *functions, int visible, int logging)
{
    Motor *m = calloc(1, sizeof(Motor));
    m->gain = 10.0, m->tau = 0.05;
    return m;
}

void fmi2FreeInstance(void *m) { free(m); }
int fmi2SetupExperiment(void *m, int has, double tolerance, double start, int ends, double stop) { return 0; }
int fmi2EnterInitializationMode(void *m) { return 0; }
int fmi2ExitInitializationMode(void *m) { return 0; }
int fmi2Terminate(void *m) { return 0; }
int fmi2Reset(void *m) { return 0; }
int fmi2SetDebugLogging(void *m, int on, size_t n, const char *const *names) { return 0; }

/* What the standard asks for beside these, and this motor has no use for: always an error. */
#define NONE(name) int fmi2##name(void *m) { return 3; }
NONE(GetInteger) NONE(GetBoolean) NONE(GetString) NONE(SetInteger) NONE(SetBoolean)
NONE(SetString) NONE(GetFMUstate) NONE(SetFMUstate) NONE(FreeFMUstate)
NONE(SerializedFMUstateSize) NONE(SerializeFMUstate) NONE(DeSerializeFMUstate)
NONE(GetDirectionalDerivative) NONE(SetRealInputDerivatives) NONE(GetRealOutputDerivatives)
NONE(CancelStep) NONE(GetStatus) NONE(GetRealStatus) NONE(GetIntegerStatus)
NONE(GetBooleanStatus) NONE(GetStringStatus)

int fmi2GetReal(void *m, const unsigned refs[], size_t n, double values[])
{
    for (size_t k = 0; k < n; k++) values[k] = *place(m, refs[k]);
    return 0;
}

int fmi2SetReal(void *m, const unsigned refs[], size_t n, const double values[])
{
    for (size_t k = 0; k < n; k++) *place(m, refs[k]) = values[k];
    return 0;
}

int fmi2DoStep(void *instance, double now, double step, int keep)
{
    Motor *m = instance;
    double end = m->gain * m->volts, left = exp(-step / m->tau), before = m->speed;
    if (fabs(m->volts) > 4.0) return 3; /* it has an end that it says */
    m->speed = end + (before - end) * left;
    m->angle += (end * step + (before - end) * m->tau * (1.0 - left)) * 57.29577951308232;
    return 0;
}
