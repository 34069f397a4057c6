/* The Product Model in C99; see product_model.h. Equation numbers are those of Profe, Kostetzer and
   Ament (SIMULTECH 2023).

   The elementary functions are computed in the way of XLA's compiler for CPUs with fused
   multiply-add (jax 0.10), which is why some are not those of <math.h>: rounding errors of the
   impact times would otherwise show in the means over short time steps. */

#include "product_model.h"

#include <float.h>
#include <math.h>

#if defined(__clang__)
#pragma STDC FP_CONTRACT OFF
#elif defined(_MSC_VER)
#pragma fp_contract(off)
#endif

typedef product_model_real real;

#define SINGLE        (sizeof(real) == sizeof(float))
#define SQRT2         ((real)1.4142135623730951)
#define LOWEST_HEIGHT 1e-9      /* (m) of a drop, as in Python */
#define FAR           536870912 /* number of a sample that no stream reaches */
#define REACH         ((real)8.5) /* standard deviations within which a Gaussian edge is rendered */

/* ---- elementary functions in either precision ---- */

/* a * b + c, rounded once. */
static real fused(real a, real b, real c)
{
#ifdef PRODUCT_MODEL_NO_FMA
    return a * b + c;
#else
    return SINGLE ? (real)fmaf((float)a, (float)b, (float)c) : (real)fma(a, b, c);
#endif
}

static real root(real x) { return SINGLE ? (real)sqrtf((float)x) : (real)sqrt(x); }

static real larger(real a, real b) { return a > b ? a : b; }

/* c[0] x^(n-1) + ... + c[n-1] by Horner's scheme. */
static real polynomial(const double *c, int n, real x)
{
    real sum = (real)c[0];
    int k;
    for (k = 1; k < n; k++) sum = fused(sum, x, (real)c[k]);
    return sum;
}

/* Natural logarithm of a positive, normal number in single precision (Cephes). */
static real log_single(real argument)
{
    static const double even[] = {0.0703768358, -0.115146101, 0.116769984};
    static const double odd[] = {-0.12420141, 0.142493233, -0.166680574};
    static const double low[] = {0.200007141, -0.24999994, 0.333333313};
    int exponent;
    real x = (real)frexp(argument, &exponent), power = (real)exponent, square, cube, sum;
    if (x < (real)0.707106769) {
        power -= 1;
        x = (x - 1) + x;
    } else {
        x = x - 1;
    }
    square = x * x;
    cube = square * x;
    sum = fused(polynomial(even, 3, x), cube, polynomial(odd, 3, x));
    sum = fused(sum, cube, polynomial(low, 3, x));
    sum = fused(sum, cube, power * (real)-0.000212194442);
    return fused(power, (real)0.693359375, fused(-square, (real)0.5, x) + sum);
}

/* log(1 + x), -1 < x (Cephes' log1p). */
static real log_plus_one(real x)
{
    static const double over[] = {4.5270000862445198e-05, 0.49854102823193375, 6.5787325942061043,
                                  29.911919328553072,     60.94966798098779,   57.112963590585537,
                                  20.039553499201283};
    static const double under[] = {1.0,
                                   15.062909083469192,
                                   83.047565967967216,
                                   221.76239823732857,
                                   309.09872225312057,
                                   216.42788614495947,
                                   60.118660497603841};
    real square = x * x;
    if (fabs((double)x) < (double)(real)0.41421356237309503) {
        real ratio = polynomial(over, 7, x) / polynomial(under, 7, x);
        return x + fused(square, (real)-0.5, (x * square) * ratio);
    }
    return SINGLE ? log_single(x + 1) : (real)log(x + 1);
}

/* Inverse of the error function, -1 <= x <= 1 (Giles, GPU Computing Gems, 2012). */
static real inverse_erf(real x)
{
    static const double single_central[] = {2.81022636e-08,  3.43273939e-07, -3.5233877e-06,
                                            -4.39150654e-06, 0.00021858087,  -0.00125372503,
                                            -0.00417768164,  0.246640727,    1.50140941};
    static const double single_tail[] = {-0.000200214257, 0.000100950558, 0.00134934322,
                                         -0.00367342844,  0.00573950773,  -0.0076224613,
                                         0.00943887047,   1.00167406,     2.83297682};
    static const double central[] = {
        -3.64441206401782e-21,  -1.6850591381820166e-19, 1.28584807152564e-18,
        1.1157877678025181e-17, -1.333171662854621e-16,  2.0972767875968562e-17,
        6.637638134358324e-15,  -4.054566272975207e-14,  -8.151934197605472e-14,
        2.6335093153082323e-12, -1.2975133253453532e-11, -5.415412054294628e-11,
        1.0512122733215323e-09, -4.112633980346984e-09,  -2.9070369957882005e-08,
        4.2347877827932404e-07, -1.3654692000834679e-06, -1.3882523362786469e-05,
        0.00018673420803405714, -0.000740702534166267,   -0.006033670871430149,
        0.24015818242558962,    1.6536545626831027};
    static const double tail[] = {
        2.2137376921775787e-09, 9.075656193888539e-08,  -2.7517406297064545e-07,
        1.8239629214389228e-08, 1.5027403968909828e-06, -4.013867526981546e-06,
        2.9234449089955446e-06, 1.2475304481671779e-05, -4.7318229009055734e-05,
        6.828485145957318e-05,  2.4031110387097894e-05, -0.0003550375203628475,
        0.0009532893797373805,  -0.0016882755560235047, 0.002491442096107851,
        -0.003751208507569241,  0.005370914553590064,   1.0052589676941592,
        3.0838856104922208};
    static const double far_tail[] = {
        -2.7109920616438573e-11, -2.555641816996525e-10,  1.5076572693500548e-09,
        -3.789465440126737e-09,  7.61570120807834e-09,    -1.496002662714924e-08,
        2.914795345090108e-08,   -6.771199775845234e-08,  2.2900482228026655e-07,
        -9.9298272942317e-07,    4.526062597223154e-06,   -1.968177810553167e-05,
        7.599527703001776e-05,   -0.00021503011930044477, -0.00013871931833623122,
        1.0103004648645344,      4.849906401408584};
    real w = -log_plus_one(-(x * x));
    if (x == 1 || x == -1) return x * (real)INFINITY;
    if (SINGLE)
        return x * (w < 5 ? polynomial(single_central, 9, w - (real)2.5)
                          : polynomial(single_tail, 9, root(w) - 3));
    if (w < (real)6.25) return x * polynomial(central, 23, w - (real)3.125);
    if (w < 16) return x * polynomial(tail, 19, root(w) - (real)3.25);
    return x * polynomial(far_tail, 17, root(w) - 5);
}

/* The error function, in single precision as XLA has it. */
static real error_function(real x)
{
    static const double over[] = {0.000229050653, 0.00340829091, 0.0509556942, 0.185208321,
                                  1.12837911};
    static const double under[] = {-1.17916031e-07,
                                   2.35479656e-05,
                                   0.00101796258,
                                   0.0140704699,
                                   0.110985048,
                                   0.497469246,
                                   1.0};
    real square;
    if (!SINGLE) return (real)erf(x);
    if (fabs((double)x) >= (double)(real)3.74392128) return x < 0 ? (real)-1 : (real)1;
    square = x * x;
    return x * polynomial(over, 5, square) / polynomial(under, 7, square);
}

/* ---- random numbers: Threefry-2x32 with 20 rounds (Salmon et al., SC 2011) ---- */

static void threefry(const uint32_t key[2], uint32_t high, uint32_t low, uint32_t words[2])
{
    static const int distances[2][4] = {{13, 15, 26, 6}, {17, 29, 16, 24}};
    uint32_t keys[3], a, b;
    int turn, round;
    keys[0] = key[0];
    keys[1] = key[1];
    keys[2] = key[0] ^ key[1] ^ UINT32_C(0x1BD11BDA);
    a = high + keys[0];
    b = low + keys[1];
    for (turn = 0; turn < 5; turn++) {
        for (round = 0; round < 4; round++) {
            int distance = distances[turn % 2][round];
            a += b;
            b = a ^ ((b << distance) | (b >> (32 - distance)));
        }
        a += keys[(turn + 1) % 3];
        b += keys[(turn + 2) % 3] + (uint32_t)turn + 1;
    }
    words[0] = a;
    words[1] = b;
}

void product_model_split_key(const uint32_t key[2], uint32_t index, uint32_t new_key[2])
{
    threefry(key, 0, index, new_key);
}

/* Number `index` of a key, uniform on [0, 1). */
static real uniform(const uint32_t key[2], uint32_t index)
{
    uint32_t words[2];
    threefry(key, 0, index, words);
    if (SINGLE) return (real)((words[0] ^ words[1]) >> 9) * (real)(1.0 / 8388608.0);
    return (real)((((uint64_t)words[0] << 32) | words[1]) >> 12) * (real)(1.0 / 4503599627370496.0);
}

/* Number `index` of a key, uniform on (-1, 1). */
static real uniform_between_signs(const uint32_t key[2], uint32_t index)
{
    real lowest = -1 + (SINGLE ? (real)(FLT_EPSILON / 2) : (real)(DBL_EPSILON / 2));
    return larger(lowest, 2 * uniform(key, index) + lowest);
}

/* ---- the edges of the pulses: a binary heap, the earliest first ---- */

static int is_earlier(const product_model_edge *a, const product_model_edge *b)
{
    return a->whole < b->whole || (a->whole == b->whole && a->fraction < b->fraction);
}

static void swap_edges(product_model_edge *a, product_model_edge *b)
{
    product_model_edge kept = *a;
    *a = *b;
    *b = kept;
}

static void sift_down(product_model_edge *heap, int32_t size, int32_t parent)
{
    for (;;) {
        int32_t child = 2 * parent + 1;
        if (child >= size) return;
        if (child + 1 < size && is_earlier(&heap[child + 1], &heap[child])) child++;
        if (!is_earlier(&heap[child], &heap[parent])) return;
        swap_edges(&heap[child], &heap[parent]);
        parent = child;
    }
}

/* Move the earliest waiting edge behind the heap. */
static void pop_edge(product_model_state *state)
{
    state->waiting--;
    swap_edges(&state->edges[0], &state->edges[state->waiting]);
    sift_down(state->edges, state->waiting, 0);
}

static void add_edge(product_model_state *state, real position, real level)
{
    product_model_edge *edge = &state->edges[state->count++];
    int is_far = !(fabs((double)position) < FAR);
    real whole = (real)floor(position);
    edge->whole = !is_far ? (int32_t)whole : position < 0 ? -FAR : FAR;
    edge->fraction = !is_far ? position - whole : 0;
    edge->level = level;
}

/* ---- a portion ---- */

static int is_positive(double x) { return x > 0 && x <= DBL_MAX; }

static int are_allowed(const product_model_parameters *p)
{
    return is_positive(p->h_mean) && p->gamma_low >= 0 && p->gamma_low <= p->gamma_high &&
           p->gamma_high <= DBL_MAX && is_positive(p->dt_impact) && is_positive(p->m_piece) &&
           is_positive(p->gravity) && is_positive(p->sample) && fabs(p->start) <= DBL_MAX &&
           p->pieces >= 0 && (p->pieces > 0 || is_positive(p->m_target)) &&
           p->form >= PRODUCT_MODEL_RECTANGULAR && p->form <= PRODUCT_MODEL_SMOOTH &&
           (p->form != PRODUCT_MODEL_SMOOTH || is_positive(p->smooth_width));
}

/* Eq. 16, at most one more than there is room for. */
static int32_t number_of_pieces(const product_model_parameters *p, double target)
{
    double pieces = target > 0      ? floor(target / p->m_piece + 0.5)
                    : p->pieces > 0 ? (double)p->pieces
                                    : floor(p->m_target / p->m_piece + 0.5);
    if (pieces < 1) return 1;
    return pieces > PRODUCT_MODEL_MAX_PIECES ? PRODUCT_MODEL_MAX_PIECES + 1 : (int32_t)pieces;
}

/* Eqs 19-22: standard deviation (m) of the drop heights of this portion. */
static real sigma_height(const product_model_parameters *p, const uint32_t key[2])
{
    real low = (real)p->gamma_low, high = (real)p->gamma_high;
    real normal = inverse_erf(uniform_between_signs(key, 0)) * SQRT2;
    return fused((high - low) * ((real)1 / (real)3), larger(normal, 0), low);
}

/* Eq. 18 for a number v on (-1, 1): a drop height (m). One that would be negative, which has the
   probability `negative`, is drawn again from the rest of the distribution, with v as its random
   number. */
static real drop_height(real h_mean, real sigma, real negative, real v)
{
    real below = (v + 1) * (real)0.5;
    if (below < negative) v = 2 * fused(below / negative, 1 - negative, negative) - 1;
    return larger(fused(inverse_erf(v), sigma * SQRT2, h_mean), (real)LOWEST_HEIGHT);
}

/* The two edges of each piece's pulse, eqs 9-14 and 17. */
static void add_pulses(product_model_state *state, const product_model_parameters *p,
                       const uint32_t key[2], int32_t pieces)
{
    real h_mean = (real)p->h_mean, gravity = (real)p->gravity, mass = (real)p->m_piece;
    real length = (real)p->dt_impact;
    real start = (real)p->start, per_second = 1 / state->sample, weight = mass * gravity;
    real earliest = p->form == PRODUCT_MODEL_SMOOTH ? -(REACH * state->width + 4) : 0;
    real sigma = sigma_height(p, key), negative = 0;
    int32_t piece;
    if (sigma > 0) negative = (real)0.5 - (real)0.5 * error_function(h_mean / sigma * (1 / SQRT2));
    for (piece = 0; piece < pieces; piece++) {
        real height =
            drop_height(h_mean, sigma, negative, uniform_between_signs(key, (uint32_t)piece + 1));
        real time = root(height * 2 / gravity), force = mass * (gravity * time) / length;
        add_edge(state, larger((time - start) * per_second, earliest), force);
        add_edge(state, larger(((time + length) - start) * per_second, earliest), weight - force);
    }
}

int product_model_start_with_key(product_model_state *state,
                                 const product_model_parameters *parameters, const uint32_t key[2],
                                 double target)
{
    int32_t pieces;
    state->count = 0;
    state->sample = 1;
    state->form = PRODUCT_MODEL_INTERVAL_MEAN;
    product_model_reset(state);
    if (!are_allowed(parameters) || !(target >= 0 && target <= DBL_MAX))
        return PRODUCT_MODEL_BAD_PARAMETER;
    pieces = number_of_pieces(parameters, target);
    if (pieces > PRODUCT_MODEL_MAX_PIECES) return PRODUCT_MODEL_TOO_MANY_PIECES;
    state->sample = (real)parameters->sample;
    state->width = (real)(parameters->smooth_width / parameters->sample);
    state->form = parameters->form;
    add_pulses(state, parameters, key, pieces);
    product_model_reset(state);
    return PRODUCT_MODEL_OK;
}

int product_model_start(product_model_state *state, const product_model_parameters *parameters,
                        uint32_t seed, double target)
{
    uint32_t key[2] = {0, 0};
    key[1] = seed;
    return product_model_start_with_key(state, parameters, key, target);
}

void product_model_reset(product_model_state *state)
{
    int32_t parent;
    state->waiting = state->unfinished = state->count;
    state->whole = 0;
    state->fraction = state->level = state->level_error = state->dt = 0;
    for (parent = state->count / 2 - 1; parent >= 0; parent--)
        sift_down(state->edges, state->count, parent);
}

/* ---- a time step ---- */

/* Add to the force of the edges that act in full; the rounding error is kept (Neumaier). */
static void add_level(product_model_state *state, real level)
{
    real sum = state->level + level;
    int is_smaller = fabs((double)state->level) < fabs((double)level);
    state->level_error += is_smaller ? (level - sum) + state->level : (state->level - sum) + level;
    state->level = sum;
}

/* Keep the length of the time step dt in samples; whole but for rounding, it is made whole. */
static void set_step(product_model_state *state, real dt)
{
    real steps = dt / state->sample, nearest = (real)floor((double)steps + 0.5), whole;
    real rounding = 4 * (SINGLE ? (real)FLT_EPSILON : (real)DBL_EPSILON);
    if (fabs((double)(steps - nearest)) <= (double)(rounding * nearest)) steps = nearest;
    whole = (real)floor((double)steps);
    state->dt = dt;
    state->steps = steps;
    state->step_whole = whole < FAR ? (int32_t)whole : FAR;
    state->step_fraction = whole < FAR ? steps - whole : 0;
}

static void advance_time(product_model_state *state)
{
    state->whole += state->step_whole;
    state->fraction += state->step_fraction;
    if (state->fraction >= 1) {
        state->fraction -= 1;
        state->whole++;
    }
    if (state->whole > FAR) state->whole = FAR; /* in which no edge is missed */
}

/* Samples from an edge to the present; negative if it is still to come. */
static real time_since(const product_model_state *state, const product_model_edge *edge)
{
    return (real)(state->whole - edge->whole) + (state->fraction - edge->fraction);
}

/* Integral of a Gaussian step of unit width, u Phi(u) + phi(u). */
static real ramp(real u)
{
    double below = -fabs((double)u);
    return larger(u, 0) + (real)(0.5 * below * erfc(-below / 1.4142135623730951) +
                                 exp(-0.5 * below * below) / 2.5066282746310002);
}

/* The part of a time step of `steps` samples in which a smooth edge acts. */
static real smooth_part(const product_model_state *state, const product_model_edge *edge,
                        real steps)
{
    real now = time_since(state, edge);
    return state->width * (ramp(now / state->width) - ramp((now - steps) / state->width)) / steps;
}

/* The force of the edges that act in part of the time step; those that act in full from now on are
   added to the level. */
static real unfinished_force(product_model_state *state, real steps)
{
    real force = 0, beyond = state->form == PRODUCT_MODEL_SMOOTH ? REACH * state->width : 0;
    int32_t k;
    for (k = state->unfinished - 1; k >= state->waiting; k--) { /* from the earliest on */
        const product_model_edge *edge = &state->edges[k];
        real part = 1;
        if (state->form == PRODUCT_MODEL_SMOOTH) part = smooth_part(state, edge, steps);
        if (state->form == PRODUCT_MODEL_INTERVAL_MEAN) part = time_since(state, edge) / steps;
        force += edge->level * (part < 1 ? part : 1);
    }
    while (state->unfinished > state->waiting &&
           time_since(state, &state->edges[state->unfinished - 1]) >= beyond)
        add_level(state, state->edges[--state->unfinished].level);
    return force;
}

product_model_real product_model_step(product_model_state *state, product_model_real dt)
{
    real before = state->level + state->level_error;
    real ahead = state->form == PRODUCT_MODEL_SMOOTH ? -REACH * state->width : 0;
    if (state->unfinished == 0 || !(dt > 0)) return before;
    if (dt != state->dt) set_step(state, dt);
    advance_time(state);
    while (state->waiting > 0 && time_since(state, &state->edges[0]) >= ahead) pop_edge(state);
    if (state->unfinished == state->waiting) return before;
    return before + unfinished_force(state, state->steps);
}

/* Number of coming time steps, at most `count`, in which certainly no edge acts in part. */
static int32_t count_quiet_steps(const product_model_state *state, int32_t count)
{
    int32_t quiet;
    if (state->unfinished == 0) return count;
    if (state->unfinished > state->waiting || state->form == PRODUCT_MODEL_SMOOTH) return 0;
    if (state->step_fraction > 0 || state->step_whole == 0) return 0;
    quiet = (state->edges[0].whole - 1 - state->whole) / state->step_whole;
    return quiet < 0 ? 0 : quiet < count ? quiet : count;
}

void product_model_steps(product_model_state *state, product_model_real dt,
                         product_model_real *forces, int32_t count)
{
    int32_t done = 0;
    while (done < count) {
        int32_t quiet = dt == state->dt ? count_quiet_steps(state, count - done) : 0, k;
        real level = state->level + state->level_error;
        for (k = 0; k < quiet; k++) forces[done + k] = level;
        if (state->unfinished > 0) state->whole += quiet * state->step_whole;
        done += quiet;
        if (done < count) forces[done++] = product_model_step(state, dt);
    }
}
