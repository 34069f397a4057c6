/* A functional mock-up unit of an estimator of the weight: the part that FMI 2.0 and FMI 3.0 share.
   weigher_data.h is generated. */

#ifndef WEIGHER_UNIT_H
#define WEIGHER_UNIT_H

#include "weigher.h"
#include "weigher_token.h"

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

/* Value references. */
enum { SAMPLE = 0, GRAMS, SD, BELIEVED, STATUS, DOUBTS, TIME };

/* All that changes, plain data: a copy of it is the state of the unit. */
typedef struct {
    double time, sample;
    weigher_reading reading;
    weigher_state state;
} unit_values;

typedef struct {
    unit_values values;
    char name[256];
    void *environment; /* of the tool, and its function for messages */
    void (*log)(void);
} unit;

static void reset_unit(unit *u)
{
    memset(&u->values, 0, sizeof u->values);
    weigher_start(&u->values.state);
}

static unit *make_unit(const char *name, const char *token, void *environment, void (*log)(void))
{
    unit *u;
    if (!token || strcmp(token, WEIGHER_TOKEN) != 0) return NULL;
    u = calloc(1, sizeof *u);
    if (!u) return NULL;
    if (name) strncpy(u->name, name, sizeof u->name - 1);
    u->environment = environment;
    u->log = log;
    reset_unit(u);
    return u;
}

static const char *begin_simulation(unit *u)
{
    weigher_start(&u->values.state);
    return NULL;
}

/* Feeds the input for each interval of the scale in the step. Returns NULL or what is wrong. */
static const char *advance_unit(unit *u, double time, double step)
{
    unit_values *v = &u->values;
    double count = floor(step / weigher_interval() + 0.5);
    if (!(count >= 1) || fabs(step / weigher_interval() - count) > 1e-6 * count)
        return "the step must be a multiple of the interval between samples";
    for (; count > 0; count--) v->reading = weigher_feed(&v->state, v->sample);
    v->time = time + step;
    return NULL;
}

/* The variable of a value reference; NULL if there is none of this type. */
static double *find_real(unit *u, unsigned reference)
{
    return reference == SAMPLE  ? &u->values.sample
           : reference == GRAMS ? &u->values.reading.grams
           : reference == SD    ? &u->values.reading.sd
           : reference == TIME  ? &u->values.time
                                : NULL;
}

static int32_t *find_integer(unit *u, unsigned reference)
{
    return reference == STATUS   ? &u->values.reading.status
           : reference == DOUBTS ? &u->values.reading.doubts
                                 : NULL;
}

static int32_t *find_boolean(unit *u, unsigned reference)
{
    return reference == BELIEVED ? &u->values.reading.believed : NULL;
}

#endif
