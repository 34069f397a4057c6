/* The Product Model as a co-simulation unit of FMI 2.0 (https://fmi-standard.org). */

#include "unit.h"
#include "unit_state.h"

typedef void logger(void *environment, const char *name, int status, const char *category,
                    const char *message, ...);

typedef struct {
    logger *log;
    void *(*allocate)(size_t, size_t);
    void (*release)(void *);
    void (*step_finished)(void *, int);
    void *environment;
} callbacks;

static int report(unit *u, const char *error)
{
    if (error && u->log)
        ((logger *)u->log)(u->environment, u->name, STATUS_ERROR, "logStatusError", "%s", error);
    return error ? STATUS_ERROR : STATUS_OK;
}

EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }
EXPORT const char *fmi2GetVersion(void) { return "2.0"; }
EXPORT int fmi2SetDebugLogging(void *u, int on, size_t n, const char *const categories[])
{
    return STATUS_OK;
}

EXPORT void *fmi2Instantiate(const char *name, int type, const char *token, const char *resources,
                             const callbacks *functions, int visible, int logging)
{
    void (*log)(void) = functions ? (void (*)(void))functions->log : NULL;
    return type == 1 ? make_unit(name, token, functions ? functions->environment : NULL, log)
                     : NULL; /* 1: co-simulation */
}

EXPORT void fmi2FreeInstance(void *u) { free(u); }

EXPORT int fmi2SetupExperiment(void *u, int has_tolerance, double tolerance, double start,
                               int has_stop, double stop)
{
    ((unit *)u)->values.time = start;
    return STATUS_OK;
}

EXPORT int fmi2EnterInitializationMode(void *u) { return STATUS_OK; }
EXPORT int fmi2ExitInitializationMode(void *u) { return report(u, begin_simulation(u)); }
EXPORT int fmi2Terminate(void *u) { return STATUS_OK; }

EXPORT int fmi2Reset(void *u)
{
    reset_unit(u);
    return STATUS_OK;
}

EXPORT int fmi2DoStep(void *u, double time, double step, int is_final)
{
    return report(u, advance_unit(u, time, step));
}

/* Read or write the variables of one type. */
#define ACCESS(Type, type, find)                                                                   \
    EXPORT int fmi2Get##Type(void *u, const unsigned references[], size_t n, type values[])        \
    {                                                                                              \
        size_t k;                                                                                  \
        for (k = 0; k < n; k++) {                                                                  \
            if (!find(u, references[k]))                                                           \
                return report(u, "fmi2Get" #Type ": unknown value reference");                     \
            values[k] = *find(u, references[k]);                                                   \
        }                                                                                          \
        return STATUS_OK;                                                                          \
    }                                                                                              \
    EXPORT int fmi2Set##Type(void *u, const unsigned references[], size_t n, const type values[])  \
    {                                                                                              \
        size_t k;                                                                                  \
        for (k = 0; k < n; k++) {                                                                  \
            if (!find(u, references[k]))                                                           \
                return report(u, "fmi2Set" #Type ": unknown value reference");                     \
            *find(u, references[k]) = values[k];                                                   \
        }                                                                                          \
        return STATUS_OK;                                                                          \
    }
ACCESS(Real, double, find_real)
ACCESS(Integer, int, find_integer)
ACCESS(Boolean, int, find_boolean)

EXPORT int fmi2GetString(void *u, const unsigned references[], size_t n, const char *values[])
{
    return n ? report(u, "the unit has no strings") : STATUS_OK;
}
EXPORT int fmi2SetString(void *u, const unsigned references[], size_t n, const char *const values[])
{
    return n ? report(u, "the unit has no strings") : STATUS_OK;
}

/* ---- the state: a copy of all values ---- */

EXPORT int fmi2GetFMUstate(void *u, void **state)
{
    return report(u, keep_values(&((unit *)u)->values, state));
}

EXPORT int fmi2SetFMUstate(void *u, void *state)
{
    memcpy(&((unit *)u)->values, state, sizeof(unit_values));
    return STATUS_OK;
}

EXPORT int fmi2FreeFMUstate(void *u, void **state)
{
    free_values(state);
    return STATUS_OK;
}

EXPORT int fmi2SerializedFMUstateSize(void *u, void *state, size_t *size)
{
    *size = sizeof(unit_values);
    return STATUS_OK;
}

EXPORT int fmi2SerializeFMUstate(void *u, void *state, char bytes[], size_t size)
{
    if (size < sizeof(unit_values)) return report(u, "fmi2SerializeFMUstate: too few bytes");
    memcpy(bytes, state, sizeof(unit_values));
    return STATUS_OK;
}

EXPORT int fmi2DeSerializeFMUstate(void *u, const char bytes[], size_t size, void **state)
{
    if (size != sizeof(unit_values))
        return report(u, "fmi2DeSerializeFMUstate: not a state of this unit");
    return report(u, keep_values(bytes, state));
}

/* ---- not offered, as modelDescription.xml says ---- */

EXPORT int fmi2GetDirectionalDerivative(void *u, const unsigned unknowns[], size_t n,
                                        const unsigned knowns[], size_t m, const double seed[],
                                        double sensitivity[])
{
    return report(u, "the unit has no directional derivatives");
}
EXPORT int fmi2SetRealInputDerivatives(void *u, const unsigned references[], size_t n,
                                       const int orders[], const double values[])
{
    return report(u, "the unit takes no derivatives of inputs");
}
EXPORT int fmi2GetRealOutputDerivatives(void *u, const unsigned references[], size_t n,
                                        const int orders[], double values[])
{
    return report(u, "the unit gives no derivatives of outputs");
}
EXPORT int fmi2CancelStep(void *u) { return report(u, "no step is in progress"); }
EXPORT int fmi2GetStatus(void *u, int kind, int *value)
{
    return report(u, "no step is in progress");
}
EXPORT int fmi2GetRealStatus(void *u, int kind, double *value)
{
    return report(u, "no step is in progress");
}
EXPORT int fmi2GetIntegerStatus(void *u, int kind, int *value)
{
    return report(u, "no step is in progress");
}
EXPORT int fmi2GetBooleanStatus(void *u, int kind, int *value)
{
    return report(u, "no step is in progress");
}
EXPORT int fmi2GetStringStatus(void *u, int kind, const char **value)
{
    return report(u, "no step is in progress");
}
