
/* The interface: FMI 3.0 for co-simulation. Inputs are held over a communication step, which an
   explicit Runge-Kutta pair of orders 5 and 4 (Dormand and Prince, 1980) divides by its error. */

#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

typedef enum { OK, WARNING, DISCARD, ERROR, FATAL } Status;
typedef void (*Log)(void *environment, Status status, const char *category, const char *message);
typedef const uint32_t *Refs;
typedef const uint8_t *Bytes;

/* largest: magnitude of each state so far, which its error is compared with. step: last length. */
typedef struct {
    double time, step, tolerance;
    double x[N_STATES], largest[N_STATES], start[N_STATES];
    double u[N_INPUTS + 1], p[N_PARAMETERS + 1];
    bool running;
} Model;

typedef struct {
    Model model;
    void *environment;
    Log log;
} Instance;

static Status fail(Instance *instance, const char *message)
{
    if (instance->log) {
        instance->log(instance->environment, ERROR, "logStatusError", message);
    }
    return ERROR;
}

static void reset(Model *model)
{
    memset(model, 0, sizeof *model);
    memcpy(model->p, PARAMETERS, sizeof PARAMETERS);
    memcpy(model->start, INITIAL, sizeof INITIAL);
    memcpy(model->x, INITIAL, sizeof INITIAL);
    model->tolerance = TOLERANCE;
}

static const double A[6][6] = {
    { 1.0 / 5.0 },
    { 3.0 / 40.0, 9.0 / 40.0 },
    { 44.0 / 45.0, -56.0 / 15.0, 32.0 / 9.0 },
    { 19372.0 / 6561.0, -25360.0 / 2187.0, 64448.0 / 6561.0, -212.0 / 729.0 },
    { 9017.0 / 3168.0, -355.0 / 33.0, 46732.0 / 5247.0, 49.0 / 176.0, -5103.0 / 18656.0 },
    { 35.0 / 384.0, 0.0, 500.0 / 1113.0, 125.0 / 192.0, -2187.0 / 6784.0, 11.0 / 84.0 },
};
static const double E[7] = { 71.0 / 57600.0, 0.0, -71.0 / 16695.0, 71.0 / 1920.0,
    -17253.0 / 339200.0, 22.0 / 525.0, -1.0 / 40.0 };

/* One step of length h into y; its error in parts of what is allowed. */
static double try_step(const Model *model, double h, double *y)
{
    double k[7][N_STATES], sum = 0.0;
    slopes(model->x, model->u, model->p, k[0]);
    for (int stage = 0; stage < 6; stage++) {
        for (int i = 0; i < N_STATES; i++) {
            double change = 0.0;
            for (int j = 0; j <= stage; j++) {
                change += A[stage][j] * k[j][i];
            }
            y[i] = model->x[i] + h * change;
        }
        slopes(y, model->u, model->p, k[stage + 1]);
    }
    for (int i = 0; i < N_STATES; i++) {
        double error = 0.0;
        double size = fmax(fmax(model->largest[i], fabs(y[i])), 1e-4);
        for (int stage = 0; stage < 7; stage++) {
            error += E[stage] * k[stage][i];
        }
        error *= h / (model->tolerance * size);
        sum += error * error;
    }
    return sqrt(sum / N_STATES);
}

/* Move the states over a time; whether they stay finite. */
static bool advance_by(Model *model, double time)
{
    double left = time, least = 1e-9 * time, y[N_STATES];
    if (!(model->step > 0.0) || model->step > time) {
        model->step = time;
    }
    while (left > 0.0) {
        double h = fmin(model->step, left);
        double error = try_step(model, h, y);
        bool finite = isfinite(error);
        if (!finite && h <= least) {
            return false;
        }
        if (error <= 1.0 || (finite && h <= least)) {
            for (int i = 0; i < N_STATES; i++) {
                model->x[i] = y[i];
                model->largest[i] = fmax(model->largest[i], fabs(y[i]));
            }
            left = h < left ? left - h : 0.0;
        }
        double factor = finite ? 0.9 * pow(fmax(error, 1e-10), -0.2) : 0.1;
        double next = h * fmin(fmax(factor, 0.1), 5.0);
        /* A step that only the end cut short says little of how long one may be. */
        if (error > 1.0 || !finite || h >= model->step || next > model->step) {
            model->step = fmax(next, least);
        }
    }
    return true;
}

static Status get(Instance *instance, uint32_t ref, double *value)
{
    Model *model = &instance->model;
    double y[N_OUTPUTS + 1];
    if (ref == 0) {
        *value = model->time;
    } else if (ref < FIRST_PARAMETER) {
        *value = model->u[ref - FIRST_INPUT];
    } else if (ref < FIRST_START) {
        *value = model->p[ref - FIRST_PARAMETER];
    } else if (ref < FIRST_OUTPUT) {
        *value = model->start[ref - FIRST_START];
    } else if (ref < FIRST_STATE) {
        observe(model->x, model->u, model->p, y);
        *value = y[ref - FIRST_OUTPUT];
    } else if (ref < FIRST_STATE + N_STATES) {
        *value = model->x[ref - FIRST_STATE];
    } else {
        return fail(instance, "no such variable");
    }
    return OK;
}

static Status set(Instance *instance, uint32_t ref, double value)
{
    Model *model = &instance->model;
    if (!isfinite(value)) {
        return fail(instance, "values must be finite");
    }
    if (ref >= FIRST_INPUT && ref < FIRST_PARAMETER) {
        model->u[ref - FIRST_INPUT] = value;
    } else if (ref >= FIRST_PARAMETER && ref < FIRST_START) {
        model->p[ref - FIRST_PARAMETER] = value;
    } else if (ref >= FIRST_START && ref < FIRST_OUTPUT && !model->running) {
        model->start[ref - FIRST_START] = model->x[ref - FIRST_START] = value;
    } else {
        return fail(instance, "this variable cannot be set now");
    }
    return OK;
}

EXPORT const char *fmi3GetVersion(void) { return "3.0"; }

EXPORT Status fmi3SetDebugLogging(void *instance, bool on, size_t n, const char *const names[])
{
    (void)instance, (void)on, (void)n, (void)names;
    return OK;
}

EXPORT void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *resources,
    bool visible, bool logging, bool event_mode, bool early_return, Refs required, size_t n_required,
    void *environment, Log log, void (*update)(void))
{
    (void)name, (void)resources, (void)visible, (void)logging, (void)event_mode;
    (void)early_return, (void)required, (void)n_required, (void)update;
    if (!token || strcmp(token, TOKEN) != 0) {
        if (log) {
            log(environment, ERROR, "logStatusError", "the token is not this model's");
        }
        return NULL;
    }
    Instance *instance = malloc(sizeof *instance);
    if (instance) {
        reset(&instance->model);
        instance->environment = environment;
        instance->log = log;
    }
    return instance;
}

EXPORT void *fmi3InstantiateModelExchange(const char *name, const char *token,
    const char *resources, bool visible, bool logging, void *environment, Log log)
{
    (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)environment;
    (void)log;
    return NULL;
}

EXPORT void *fmi3InstantiateScheduledExecution(const char *name, const char *token,
    const char *resources, bool visible, bool logging, void *environment, Log log,
    void (*update)(void), void (*lock)(void), void (*unlock)(void))
{
    (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)environment;
    (void)log, (void)update, (void)lock, (void)unlock;
    return NULL;
}

EXPORT void fmi3FreeInstance(void *instance) { free(instance); }

EXPORT Status fmi3EnterInitializationMode(void *instance, bool has_tolerance, double tolerance,
    double start, bool has_stop, double stop)
{
    Model *model = &((Instance *)instance)->model;
    (void)has_stop, (void)stop;
    if (has_tolerance && tolerance > 0.0) {
        model->tolerance = fmin(fmax(tolerance, 1e-12), 1e-3);
    }
    model->time = start;
    return OK;
}

EXPORT Status fmi3ExitInitializationMode(void *instance)
{
    ((Instance *)instance)->model.running = true;
    return OK;
}

EXPORT Status fmi3Terminate(void *instance)
{
    ((Instance *)instance)->model.running = false;
    return OK;
}

EXPORT Status fmi3Reset(void *instance)
{
    reset(&((Instance *)instance)->model);
    return OK;
}

EXPORT Status fmi3DoStep(void *handle, double time, double length, bool no_return, bool *event,
    bool *terminate, bool *early, double *last)
{
    Instance *instance = handle;
    Model *model = &instance->model;
    (void)no_return, (void)time;
    *event = *terminate = *early = false;
    *last = model->time;
    if (!model->running || !(length > 0.0)) {
        return fail(instance, "a step needs an initialised model and a length above zero");
    }
    if (!advance_by(model, length)) {
        return fail(instance, "the states grow beyond all bounds");
    }
    *last = model->time += length;
    return OK;
}

EXPORT Status fmi3GetFloat64(void *instance, Refs refs, size_t n, double values[], size_t n_values)
{
    Status status = n == n_values ? OK : ERROR;
    for (size_t k = 0; k < n && status == OK; k++) {
        status = get(instance, refs[k], &values[k]);
    }
    return status;
}

EXPORT Status fmi3SetFloat64(void *instance, Refs refs, size_t n, const double values[],
    size_t n_values)
{
    Status status = n == n_values ? OK : ERROR;
    for (size_t k = 0; k < n && status == OK; k++) {
        status = set(instance, refs[k], values[k]);
    }
    return status;
}

/* There are no variables of other types. */
#define NO_TYPE(name, type) \
    EXPORT Status fmi3Get##name(void *instance, Refs refs, size_t n, type values[], size_t n_values) \
    { \
        (void)instance, (void)refs, (void)values, (void)n_values; \
        return n ? ERROR : OK; \
    } \
    EXPORT Status fmi3Set##name(void *instance, Refs refs, size_t n, const type values[], \
        size_t n_values) \
    { \
        (void)instance, (void)refs, (void)values, (void)n_values; \
        return n ? ERROR : OK; \
    }
NO_TYPE(Float32, float)
NO_TYPE(Int8, int8_t)
NO_TYPE(UInt8, uint8_t)
NO_TYPE(Int16, int16_t)
NO_TYPE(UInt16, uint16_t)
NO_TYPE(Int32, int32_t)
NO_TYPE(UInt32, uint32_t)
NO_TYPE(Int64, int64_t)
NO_TYPE(UInt64, uint64_t)
NO_TYPE(Boolean, bool)

typedef const char *Text;
NO_TYPE(String, Text)

EXPORT Status fmi3GetBinary(void *instance, Refs refs, size_t n, size_t sizes[], Bytes values[],
    size_t n_values)
{
    (void)instance, (void)refs, (void)sizes, (void)values, (void)n_values;
    return n ? ERROR : OK;
}

EXPORT Status fmi3SetBinary(void *instance, Refs refs, size_t n, const size_t sizes[],
    const Bytes values[], size_t n_values)
{
    (void)instance, (void)refs, (void)sizes, (void)values, (void)n_values;
    return n ? ERROR : OK;
}

EXPORT Status fmi3GetClock(void *instance, Refs refs, size_t n, bool values[])
{
    (void)instance, (void)refs, (void)values;
    return n ? ERROR : OK;
}

EXPORT Status fmi3SetClock(void *instance, Refs refs, size_t n, const bool values[])
{
    (void)instance, (void)refs, (void)values;
    return n ? ERROR : OK;
}

/* All that changes is in Model: its state is a copy of it. */
EXPORT Status fmi3GetFMUState(void *instance, void **state)
{
    if (!*state) {
        *state = malloc(sizeof(Model));
    }
    if (!*state) {
        return fail(instance, "there is no memory left");
    }
    memcpy(*state, &((Instance *)instance)->model, sizeof(Model));
    return OK;
}

EXPORT Status fmi3SetFMUState(void *instance, void *state)
{
    memcpy(&((Instance *)instance)->model, state, sizeof(Model));
    return OK;
}

EXPORT Status fmi3FreeFMUState(void *instance, void **state)
{
    (void)instance;
    free(*state);
    *state = NULL;
    return OK;
}

EXPORT Status fmi3SerializedFMUStateSize(void *instance, void *state, size_t *size)
{
    (void)instance, (void)state;
    *size = sizeof(Model);
    return OK;
}

EXPORT Status fmi3SerializeFMUState(void *instance, void *state, uint8_t bytes[], size_t size)
{
    if (size < sizeof(Model)) {
        return fail(instance, "the state needs more room");
    }
    memcpy(bytes, state, sizeof(Model));
    return OK;
}

EXPORT Status fmi3DeserializeFMUState(void *instance, const uint8_t bytes[], size_t size,
    void **state)
{
    if (size != sizeof(Model)) {
        return fail(instance, "these bytes are no state of this model");
    }
    if (!*state) {
        *state = malloc(sizeof(Model));
    }
    if (!*state) {
        return fail(instance, "there is no memory left");
    }
    memcpy(*state, bytes, sizeof(Model));
    return OK;
}

/* What a co-simulation without events, clocks and derivatives is never asked for. */
#define NEVER(name, arguments, ...) \
    EXPORT Status name arguments \
    { \
        __VA_ARGS__; \
        return fail(instance, #name " is not for this model"); \
    }
NEVER(fmi3EnterEventMode, (void *instance), (void)0)
NEVER(fmi3EnterStepMode, (void *instance), (void)0)
NEVER(fmi3EnterConfigurationMode, (void *instance), (void)0)
NEVER(fmi3ExitConfigurationMode, (void *instance), (void)0)
NEVER(fmi3EnterContinuousTimeMode, (void *instance), (void)0)
NEVER(fmi3EvaluateDiscreteStates, (void *instance), (void)0)
NEVER(fmi3GetNumberOfVariableDependencies, (void *instance, uint32_t a, size_t *b),
    (void)a, (void)b)
NEVER(fmi3GetVariableDependencies, (void *instance, uint32_t a, size_t b[], uint32_t c[],
      size_t d[], int e[], size_t f),
    (void)a, (void)b, (void)c, (void)d, (void)e, (void)f)
NEVER(fmi3GetDirectionalDerivative, (void *instance, Refs a, size_t b, Refs c, size_t d,
      const double e[], size_t f, double g[], size_t h),
    (void)a, (void)b, (void)c, (void)d, (void)e, (void)f, (void)g, (void)h)
NEVER(fmi3GetAdjointDerivative, (void *instance, Refs a, size_t b, Refs c, size_t d,
      const double e[], size_t f, double g[], size_t h),
    (void)a, (void)b, (void)c, (void)d, (void)e, (void)f, (void)g, (void)h)
NEVER(fmi3GetIntervalDecimal, (void *instance, Refs a, size_t b, double c[], int d[]),
    (void)a, (void)b, (void)c, (void)d)
NEVER(fmi3GetIntervalFraction, (void *instance, Refs a, size_t b, uint64_t c[], uint64_t d[],
      int e[]),
    (void)a, (void)b, (void)c, (void)d, (void)e)
NEVER(fmi3GetShiftDecimal, (void *instance, Refs a, size_t b, double c[]),
    (void)a, (void)b, (void)c)
NEVER(fmi3GetShiftFraction, (void *instance, Refs a, size_t b, uint64_t c[], uint64_t d[]),
    (void)a, (void)b, (void)c, (void)d)
NEVER(fmi3SetIntervalDecimal, (void *instance, Refs a, size_t b, const double c[]),
    (void)a, (void)b, (void)c)
NEVER(fmi3SetIntervalFraction, (void *instance, Refs a, size_t b, const uint64_t c[],
      const uint64_t d[]),
    (void)a, (void)b, (void)c, (void)d)
NEVER(fmi3SetShiftDecimal, (void *instance, Refs a, size_t b, const double c[]),
    (void)a, (void)b, (void)c)
NEVER(fmi3SetShiftFraction, (void *instance, Refs a, size_t b, const uint64_t c[],
      const uint64_t d[]),
    (void)a, (void)b, (void)c, (void)d)
NEVER(fmi3UpdateDiscreteStates, (void *instance, bool *a, bool *b, bool *c, bool *d, bool *e,
      double *f),
    (void)a, (void)b, (void)c, (void)d, (void)e, (void)f)
NEVER(fmi3CompletedIntegratorStep, (void *instance, bool a, bool *b, bool *c),
    (void)a, (void)b, (void)c)
NEVER(fmi3SetTime, (void *instance, double a), (void)a)
NEVER(fmi3SetContinuousStates, (void *instance, const double a[], size_t b),
    (void)a, (void)b)
NEVER(fmi3GetContinuousStateDerivatives, (void *instance, double a[], size_t b),
    (void)a, (void)b)
NEVER(fmi3GetEventIndicators, (void *instance, double a[], size_t b), (void)a, (void)b)
NEVER(fmi3GetContinuousStates, (void *instance, double a[], size_t b), (void)a, (void)b)
NEVER(fmi3GetNominalsOfContinuousStates, (void *instance, double a[], size_t b),
    (void)a, (void)b)
NEVER(fmi3GetNumberOfEventIndicators, (void *instance, size_t *a), (void)a)
NEVER(fmi3GetNumberOfContinuousStates, (void *instance, size_t *a), (void)a)
NEVER(fmi3GetOutputDerivatives, (void *instance, Refs a, size_t b, const int32_t c[], double d[],
      size_t e),
    (void)a, (void)b, (void)c, (void)d, (void)e)
NEVER(fmi3ActivateModelPartition, (void *instance, uint32_t a, double b), (void)a, (void)b)
