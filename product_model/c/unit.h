/* A functional mock-up unit of the Product Model: the part that FMI 2.0 and FMI 3.0 share.
   product_model_parameters.h is generated. */

#ifndef PRODUCT_MODEL_UNIT_H
#define PRODUCT_MODEL_UNIT_H

#include "product_model.h"
#include "product_model_parameters.h"

#include <math.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

enum { STATUS_OK = 0, STATUS_ERROR = 3 }; /* of both versions */

/* Value references. Those of parameters that are doubles count them in their struct. */
enum { PARAMETERS = offsetof(product_model_parameters, pieces) / sizeof(double) };
enum { LANDINGS = 100 }; /* the first of product_model_landings */
enum { PIECES = 1000, SEED, RELEASE, FORCE, PIF_KG, TIME };

/* All that changes, plain data: a copy of it is the state of the unit. */
typedef struct {
    product_model_parameters parameters; /* m_target = 0: as many pieces as `pieces` says */
    double time, force, pif_kg;
    int32_t seed, fallen, release, held;
    product_model_state state;
} unit_values;

typedef struct {
    unit_values values;
    char name[256];
    void *environment; /* of the tool, and its function for messages */
    void (*log)(void);
} unit;

static void reset_unit(unit *u)
{
    static const product_model_parameters parameters = PRODUCT_MODEL_PARAMETERS;
    memset(&u->values, 0, sizeof u->values);
    u->values.parameters = parameters;
    u->values.parameters.m_target = 0;
    u->values.parameters.pieces = PRODUCT_MODEL_PIECES;
    u->values.seed = PRODUCT_MODEL_SEED;
}

static unit *make_unit(const char *name, const char *token, void *environment, void (*log)(void))
{
    unit *u;
    if (!token || strcmp(token, PRODUCT_MODEL_TOKEN) != 0) return NULL;
    u = calloc(1, sizeof *u);
    if (!u) return NULL;
    if (name) strncpy(u->name, name, sizeof u->name - 1);
    u->environment = environment;
    u->log = log;
    reset_unit(u);
    return u;
}

/* Let the next portion fall. Returns NULL or what is wrong. */
static const char *release_portion(unit *u)
{
    unit_values *v = &u->values;
    int error = product_model_start(
        &v->state, &v->parameters, (uint32_t)v->seed + (uint32_t)v->fallen, v->parameters.m_target);
    v->fallen++;
    if (error == PRODUCT_MODEL_TOO_MANY_PIECES)
        return "the portion has more pieces than the unit was compiled for";
    if (error == PRODUCT_MODEL_TOO_MANY_IMPACTS)
        return "a piece has more impacts than the unit was compiled for";
    return error ? "a parameter is out of the range that its description gives" : NULL;
}

/* The first portion begins to fall as the initialization ends. */
static const char *begin_simulation(unit *u)
{
    u->values.fallen = 0;
    u->values.held = u->values.release;
    return release_portion(u);
}

/* The step that a tool means, as it gives a difference of times: a multiple of the unit of time
   where it is one to 1e-9. */
static double intended_step(double step, double sample)
{
    double multiple = floor(step / sample + 0.5);
    return multiple > 0 && fabs(step / sample - multiple) < 1e-9 * multiple ? multiple * sample
                                                                            : step;
}

/* Returns NULL or what is wrong. */
static const char *advance_unit(unit *u, double time, double step)
{
    unit_values *v = &u->values;
    const char *error = v->release && !v->held ? release_portion(u) : NULL;
    v->held = v->release;
    if (error) return error;
    if (!(step > 0)) return "the step must be positive";
    v->force = product_model_step(&v->state,
                                  (product_model_real)intended_step(step, v->parameters.sample));
    v->pif_kg = v->force / v->parameters.gravity;
    v->time = time + step;
    return NULL;
}

/* The variable of a value reference; NULL if there is none of this type. */
static double *find_real(unit *u, unsigned reference)
{
    if (reference < PARAMETERS) return (double *)(void *)&u->values.parameters + reference;
#if PRODUCT_MODEL_MAX_IMPACTS > 0
    if (reference >= LANDINGS &&
        reference < LANDINGS + offsetof(product_model_landings, shape) / sizeof(double))
        return (double *)(void *)&u->values.parameters.landings + (reference - LANDINGS);
#endif
    return reference == FORCE    ? &u->values.force
           : reference == PIF_KG ? &u->values.pif_kg
           : reference == TIME   ? &u->values.time
                                 : NULL;
}

static int32_t *find_integer(unit *u, unsigned reference)
{
    return reference == PIECES ? &u->values.parameters.pieces
           : reference == SEED ? &u->values.seed
                               : NULL;
}

static int32_t *find_boolean(unit *u, unsigned reference)
{
    return reference == RELEASE ? &u->values.release : NULL;
}

#endif
