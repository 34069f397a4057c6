/* The Product Model of Profe, Kostetzer and Ament (SIMULTECH 2023) in C99: the force of a portion
   of piece goods that falls into the weigh bucket, one time step after the other.

   Two files, product_model.h and product_model.c; needs <math.h>, <stdint.h> and no other library;
   allocates no memory. The forces are those of `product_model.simulate` in Python for the same
   parameters and the same seed, of the paper's model and of the extended one (several landings and
   impacts of each piece, see product_model/extended.py).

       static product_model_state state;
       product_model_parameters parameters = PRODUCT_MODEL_PARAMETERS; (product_model_parameters.h)
       product_model_start(&state, &parameters, seed, 0.0);
       for (;;) force = product_model_step(&state, parameters.sample);

   Compile with -std=c99, or else with -ffp-contract=off, and without -ffast-math: both change the
   last bits of the results. Macros, given to the compiler for all files alike (-DNAME=VALUE):

   PRODUCT_MODEL_REAL         type of all computed numbers: double (default) or float
   PRODUCT_MODEL_MAX_PIECES   most pieces of a portion; decides the size of the state (default 256)
   PRODUCT_MODEL_MAX_IMPACTS  most impacts of a piece in the extended model, over all its landings;
                              decides the size of the state. 0 (default): the paper's model only
   PRODUCT_MODEL_NO_FMA       a * b + c instead of fma(a, b, c), for processors without it */

#ifndef PRODUCT_MODEL_H
#define PRODUCT_MODEL_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#ifndef PRODUCT_MODEL_REAL
#define PRODUCT_MODEL_REAL double
#endif
#ifndef PRODUCT_MODEL_MAX_PIECES
#define PRODUCT_MODEL_MAX_PIECES 256
#endif
#ifndef PRODUCT_MODEL_MAX_IMPACTS
#define PRODUCT_MODEL_MAX_IMPACTS 0
#endif

typedef PRODUCT_MODEL_REAL product_model_real;

/* What product_model_start returns. */
enum {
    PRODUCT_MODEL_OK = 0,
    PRODUCT_MODEL_BAD_PARAMETER = 1,  /* one is out of the range given below */
    PRODUCT_MODEL_TOO_MANY_PIECES = 2, /* more than PRODUCT_MODEL_MAX_PIECES */
    PRODUCT_MODEL_TOO_MANY_IMPACTS = 3 /* more than PRODUCT_MODEL_MAX_IMPACTS */
};

/* The form of the pulses, as in Python. */
enum {
    PRODUCT_MODEL_RECTANGULAR = 0,   /* the force at the end of the time step */
    PRODUCT_MODEL_INTERVAL_MEAN = 1, /* its mean over the time step: exact momentum for any step */
    PRODUCT_MODEL_SMOOTH = 2         /* the mean of pulses blurred by a Gaussian (smooth_width) */
};

#if PRODUCT_MODEL_MAX_IMPACTS > 0

/* The shape of the impacts in the extended model. */
enum { PRODUCT_MODEL_TRIANGLE = 0, PRODUCT_MODEL_RECTANGLE = 1 };

/* What the extended model has beside the paper's model, `product_model.Landings` in Python. */
typedef struct {
    double pulse_exponent; /* (1) power of its momentum with which a pulse becomes longer, 0 to 5 */
    double late_duration;  /* (s) length of a pulse of 3.3 % of the momentum after the first landing */
    double share_exponent; /* (1) evenness of the impacts of a landing, 0 to 100 */
    double impact_delay;   /* (s) mean time between the impacts of a landing, 0 to 1 */
    double rebound;        /* (1) mean share of its speed with which a piece leaves a landing, < 1 */
    double slump_depth;    /* (m) mean height that a piece falls between two landings, 0 to 1 */
    double early_weight;   /* (1) share of the weight that rests before the last landing, < 1 */
    double release_time;   /* (s) spread of the moments at which pieces leave the feed bucket, < 1 */
    double release_skew;   /* (1) skewness of these moments, -5 to 5 */
    double release_order;  /* (1) how regular they are: 0 independent, near 1 as in a queue */
    double cushioning;     /* (1) power of the place in the queue with which impacts spread, -5 to 10 */
    int32_t shape;         /*     of the impacts */
    int32_t landings;      /*     number of landings of a piece; 0: the paper's model */
    int32_t impacts[PRODUCT_MODEL_MAX_IMPACTS]; /* number of impacts of each landing, > 0 */
} product_model_landings;

#endif

/* The parameters, all in SI units and finite. They are doubles in either precision, and are rounded
   to it at the start. */
typedef struct {
    double h_mean;       /* (m)    mean drop height, > 0 */
    double gamma_low;    /* (m)    lower limit of the standard deviation of drop heights, >= 0 */
    double gamma_high;   /* (m)    its three-sigma upper limit, >= gamma_low */
    double dt_impact;    /* (s)    length of the pulse of one piece, > 0 */
    double m_piece;      /* (kg)   mass of one piece, > 0 */
    double gravity;      /* (m/s2) acceleration due to gravity, > 0 */
    double m_target;     /* (kg)   mass of a portion, > 0; used where pieces = 0 */
    double sample;       /* (s)    unit of time: the usual time step, > 0 */
    double start;        /* (s)    beginning of the first time step after the release */
    double smooth_width; /* (s)    standard deviation of the smooth form's Gaussian, > 0 */
    int32_t pieces;      /*        number of pieces; 0: m_target / m_piece, rounded (eq. 16) */
    int32_t form;        /*        form of the pulses */
#if PRODUCT_MODEL_MAX_IMPACTS > 0
    product_model_landings landings;
#endif
} product_model_parameters;

/* An edge of a pulse: from its time on the force is larger by `level`. Times are in samples since
   the beginning of the first time step: whole + fraction, 0 <= fraction < 1. */
typedef struct {
    int32_t whole;
    product_model_real fraction;
    product_model_real level; /* (N) */
} product_model_edge;

#if PRODUCT_MODEL_MAX_IMPACTS > 0
/* An impact of the extended model, which leaves no force behind. Times as in an edge. */
typedef struct {
    int32_t whole; /* beginning */
    product_model_real fraction;
    product_model_real length; /* in samples */
    product_model_real force;  /* (N) its mean */
} product_model_pulse;
#endif

/* The state of a stream: plain data, which may be copied, stored and restored.

   edges[0 ... waiting - 1] are still to come: a heap, the earliest first. Behind it are those that
   have passed, the latest first; from edges[unfinished] on they act in full.

   pulses[0 ... pulses_waiting - 1] are a heap likewise; behind it are those that act,
   and from pulses[pulses_unfinished] on those that are over. */
typedef struct {
    product_model_real sample; /* (s) unit of time */
    product_model_real width;  /* smooth_width in samples */
    int32_t form;
    int32_t count; /* number of edges */
    int32_t waiting;
    int32_t unfinished;
    int32_t whole; /* present time, as in an edge */
    product_model_real fraction;
    product_model_real dt;    /* (s) the last time step, and its length in samples: */
    product_model_real steps; /* in all, and as step_whole + step_fraction */
    product_model_real step_fraction;
    int32_t step_whole;
    product_model_real level;       /* (N) force of the edges that act in full */
    product_model_real level_error; /* (N) rounding error of this sum */
    product_model_edge edges[2 * PRODUCT_MODEL_MAX_PIECES];
#if PRODUCT_MODEL_MAX_IMPACTS > 0
    int32_t shape; /* of the pulses */
    int32_t pulse_count;
    int32_t pulses_waiting;
    int32_t pulses_unfinished;
    product_model_pulse pulses[PRODUCT_MODEL_MAX_PIECES * PRODUCT_MODEL_MAX_IMPACTS];
#endif
} product_model_state;

/* Draw a portion and let it fall.

   seed:    of the random numbers: the portion is that of `product_model.simulate(parameters, seed)`
   target:  (kg) mass of this portion, which gives the number of pieces (eq. 16); 0: as given
   returns: PRODUCT_MODEL_OK, or one of the errors above, after which the force is zero */
int product_model_start(product_model_state *state, const product_model_parameters *parameters,
                        uint32_t seed, double target);

/* The same for a random key of JAX (jax.random.key_data); product_model_start has {0, seed}. */
int product_model_start_with_key(product_model_state *state,
                                 const product_model_parameters *parameters, const uint32_t key[2],
                                 double target);

/* Advance by dt (s), > 0.

   returns: (N) force of this time step in the form of the parameters; after the last impact it is
            the weight of the portion

   Costs O(log pieces) for each edge in the time step, and otherwise nothing that grows; in the
   extended model a few operations for each impact that acts in the time step besides. */
product_model_real product_model_step(product_model_state *state, product_model_real dt);

/* The same for `count` time steps of dt (s), whose forces (N) go to forces[0 ... count - 1]. Faster
   than as many calls: between the edges of the pulses it only fills. */
void product_model_steps(product_model_state *state, product_model_real dt,
                         product_model_real *forces, int32_t count);

/* Let the same portion fall again. */
void product_model_reset(product_model_state *state);

/* Key `index` of those that jax.random.split makes of a key (with jax_threefry_partitionable, JAX's
   default), which is also jax.random.fold_in(key, index). Portion `index` of
   `product_model.ensemble` has it. */
void product_model_split_key(const uint32_t key[2], uint32_t index, uint32_t new_key[2]);

#ifdef __cplusplus
}
#endif

#endif
