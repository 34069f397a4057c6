/* The Product Model as a co-simulation unit of FMI 3.0 (https://fmi-standard.org). */

#include "unit.h"
#include "unit_state.h"

#include <stdbool.h>

typedef void logger(void *environment, int status, const char *category, const char *message);

static int report(unit *u, const char *error)
{
    if (error && u->log) ((logger *)u->log)(u->environment, STATUS_ERROR, "logStatusError", error);
    return error ? STATUS_ERROR : STATUS_OK;
}

EXPORT const char *fmi3GetVersion(void) { return "3.0"; }
EXPORT int fmi3SetDebugLogging(void *u, bool on, size_t n, const char *const categories[])
{
    return STATUS_OK;
}

EXPORT void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *resources,
                                         bool visible, bool logging, bool event_mode,
                                         bool early_return, const uint32_t intermediate[], size_t n,
                                         void *environment, logger *log, void (*update)(void))
{
    return event_mode ? NULL : make_unit(name, token, environment, (void (*)(void))log);
}

EXPORT void fmi3FreeInstance(void *u) { free(u); }

EXPORT int fmi3EnterInitializationMode(void *u, bool has_tolerance, double tolerance, double start,
                                       bool has_stop, double stop)
{
    ((unit *)u)->values.time = start;
    return STATUS_OK;
}

EXPORT int fmi3ExitInitializationMode(void *u) { return report(u, begin_simulation(u)); }
EXPORT int fmi3EnterStepMode(void *u) { return STATUS_OK; }
EXPORT int fmi3Terminate(void *u) { return STATUS_OK; }

EXPORT int fmi3Reset(void *u)
{
    reset_unit(u);
    return STATUS_OK;
}

EXPORT int fmi3DoStep(void *u, double time, double step, bool is_final, bool *needs_event,
                      bool *terminate, bool *early, double *last)
{
    int status = report(u, advance_unit(u, time, step));
    *needs_event = *terminate = *early = false;
    *last = status ? time : time + step;
    return status;
}

/* Read or write the variables of one type. */
#define ACCESS(Type, type, find)                                                                   \
    EXPORT int fmi3Get##Type(void *u, const uint32_t references[], size_t n, type values[],        \
                             size_t m)                                                             \
    {                                                                                              \
        size_t k;                                                                                  \
        for (k = 0; k < n; k++) {                                                                  \
            if (m != n || !find(u, references[k]))                                                 \
                return report(u, "fmi3Get" #Type ": unknown value reference");                     \
            values[k] = (type) * find(u, references[k]);                                           \
        }                                                                                          \
        return STATUS_OK;                                                                          \
    }                                                                                              \
    EXPORT int fmi3Set##Type(void *u, const uint32_t references[], size_t n, const type values[],  \
                             size_t m)                                                             \
    {                                                                                              \
        size_t k;                                                                                  \
        for (k = 0; k < n; k++) {                                                                  \
            if (m != n || !find(u, references[k]))                                                 \
                return report(u, "fmi3Set" #Type ": unknown value reference");                     \
            *find(u, references[k]) = values[k];                                                   \
        }                                                                                          \
        return STATUS_OK;                                                                          \
    }
ACCESS(Float64, double, find_real)
ACCESS(Int32, int32_t, find_integer)
ACCESS(Boolean, bool, find_boolean)

/* ---- the state: a copy of all values ---- */

EXPORT int fmi3GetFMUState(void *u, void **state)
{
    return report(u, keep_values(&((unit *)u)->values, state));
}

EXPORT int fmi3SetFMUState(void *u, void *state)
{
    memcpy(&((unit *)u)->values, state, sizeof(unit_values));
    return STATUS_OK;
}

EXPORT int fmi3FreeFMUState(void *u, void **state)
{
    free_values(state);
    return STATUS_OK;
}

EXPORT int fmi3SerializedFMUStateSize(void *u, void *state, size_t *size)
{
    *size = sizeof(unit_values);
    return STATUS_OK;
}

EXPORT int fmi3SerializeFMUState(void *u, void *state, uint8_t bytes[], size_t size)
{
    if (size < sizeof(unit_values)) return report(u, "fmi3SerializeFMUState: too few bytes");
    memcpy(bytes, state, sizeof(unit_values));
    return STATUS_OK;
}

EXPORT int fmi3DeserializeFMUState(void *u, const uint8_t bytes[], size_t size, void **state)
{
    if (size != sizeof(unit_values))
        return report(u, "fmi3DeserializeFMUState: not a state of this unit");
    return report(u, keep_values(bytes, state));
}

/* ---- not offered, as modelDescription.xml says ---- */

EXPORT void *fmi3InstantiateModelExchange(const char *name, const char *token,
                                          const char *resources, bool visible, bool logging,
                                          void *environment, logger *log)
{
    return NULL;
}

EXPORT void *fmi3InstantiateScheduledExecution(const char *name, const char *token,
                                               const char *resources, bool visible, bool logging,
                                               void *environment, logger *log, void (*update)(void),
                                               void (*lock)(void), void (*unlock)(void))
{
    return NULL;
}

/* A function that fails whatever its arguments are. */
#define NOT_OFFERED(name, ...)                                                                     \
    EXPORT int fmi3##name(void *u, __VA_ARGS__)                                                    \
    {                                                                                              \
        return report(u, "fmi3" #name ": not offered by this unit");                               \
    }

#define NO_VARIABLES(Type, type)                                                                   \
    NOT_OFFERED(Get##Type, const uint32_t references[], size_t n, type values[], size_t m)         \
    NOT_OFFERED(Set##Type, const uint32_t references[], size_t n, const type values[], size_t m)
NO_VARIABLES(Float32, float)
NO_VARIABLES(Int8, int8_t)
NO_VARIABLES(UInt8, uint8_t)
NO_VARIABLES(Int16, int16_t)
NO_VARIABLES(UInt16, uint16_t)
NO_VARIABLES(UInt32, uint32_t)
NO_VARIABLES(Int64, int64_t)
NO_VARIABLES(UInt64, uint64_t)
NOT_OFFERED(GetString, const uint32_t references[], size_t n, const char *values[], size_t m)
NOT_OFFERED(SetString, const uint32_t references[], size_t n, const char *const values[], size_t m)
NOT_OFFERED(GetBinary, const uint32_t references[], size_t n, size_t sizes[],
            const uint8_t *values[], size_t m)
NOT_OFFERED(SetBinary, const uint32_t references[], size_t n, const size_t sizes[],
            const uint8_t *const values[], size_t m)
NOT_OFFERED(GetClock, const uint32_t references[], size_t n, bool values[])
NOT_OFFERED(SetClock, const uint32_t references[], size_t n, const bool values[])

NOT_OFFERED(GetNumberOfVariableDependencies, uint32_t reference, size_t *n)
NOT_OFFERED(GetVariableDependencies, uint32_t dependent, size_t elements[], uint32_t independents[],
            size_t others[], int kinds[], size_t n)
NOT_OFFERED(GetDirectionalDerivative, const uint32_t unknowns[], size_t n, const uint32_t knowns[],
            size_t m, const double seed[], size_t k, double sensitivity[], size_t l)
NOT_OFFERED(GetAdjointDerivative, const uint32_t unknowns[], size_t n, const uint32_t knowns[],
            size_t m, const double seed[], size_t k, double sensitivity[], size_t l)
NOT_OFFERED(GetOutputDerivatives, const uint32_t references[], size_t n, const int32_t orders[],
            double values[], size_t m)
NOT_OFFERED(GetIntervalDecimal, const uint32_t references[], size_t n, double intervals[],
            int qualifiers[])
NOT_OFFERED(GetIntervalFraction, const uint32_t references[], size_t n, uint64_t counters[],
            uint64_t resolutions[], int qualifiers[])
NOT_OFFERED(GetShiftDecimal, const uint32_t references[], size_t n, double shifts[])
NOT_OFFERED(GetShiftFraction, const uint32_t references[], size_t n, uint64_t counters[],
            uint64_t resolutions[])
NOT_OFFERED(SetIntervalDecimal, const uint32_t references[], size_t n, const double intervals[])
NOT_OFFERED(SetIntervalFraction, const uint32_t references[], size_t n, const uint64_t counters[],
            const uint64_t resolutions[])
NOT_OFFERED(SetShiftDecimal, const uint32_t references[], size_t n, const double shifts[])
NOT_OFFERED(SetShiftFraction, const uint32_t references[], size_t n, const uint64_t counters[],
            const uint64_t resolutions[])
NOT_OFFERED(UpdateDiscreteStates, bool *again, bool *terminate, bool *nominals, bool *values,
            bool *has_next, double *next)
NOT_OFFERED(CompletedIntegratorStep, bool is_final, bool *event, bool *terminate)
NOT_OFFERED(SetTime, double time)
NOT_OFFERED(SetContinuousStates, const double states[], size_t n)
NOT_OFFERED(GetContinuousStateDerivatives, double derivatives[], size_t n)
NOT_OFFERED(GetEventIndicators, double indicators[], size_t n)
NOT_OFFERED(GetContinuousStates, double states[], size_t n)
NOT_OFFERED(GetNominalsOfContinuousStates, double nominals[], size_t n)
NOT_OFFERED(GetNumberOfEventIndicators, size_t *n)
NOT_OFFERED(GetNumberOfContinuousStates, size_t *n)
NOT_OFFERED(ActivateModelPartition, uint32_t clock, double time)

#define NOT_OFFERED_BARE(name)                                                                     \
    EXPORT int fmi3##name(void *u) { return report(u, "fmi3" #name ": not offered by this unit"); }
NOT_OFFERED_BARE(EnterEventMode)
NOT_OFFERED_BARE(EnterConfigurationMode)
NOT_OFFERED_BARE(ExitConfigurationMode)
NOT_OFFERED_BARE(EnterContinuousTimeMode)
NOT_OFFERED_BARE(EvaluateDiscreteStates)
