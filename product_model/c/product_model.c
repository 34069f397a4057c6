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

/* Samples from whole + fraction to the present; negative if that is still to come. */
static real samples_since(const product_model_state *state, int32_t whole, real fraction)
{
    return (real)(state->whole - whole) + (state->fraction - fraction);
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

/* The distribution of the drop heights of a portion. */
typedef struct {
    real mean, sigma; /* (m) */
    real negative;    /*     probability of a negative height */
} height_distribution;

static height_distribution heights_of(const product_model_parameters *p, const uint32_t key[2])
{
    height_distribution heights;
    heights.mean = (real)p->h_mean;
    heights.sigma = sigma_height(p, key);
    heights.negative = 0;
    if (heights.sigma > 0)
        heights.negative =
            (real)0.5 - (real)0.5 * error_function(heights.mean / heights.sigma * (1 / SQRT2));
    return heights;
}

/* Eq. 18: drop height (m) of a piece. One that would be negative is drawn again from the rest of the
   distribution, with v as its random number. */
static real drop_height(const height_distribution *heights, const uint32_t key[2], int32_t piece)
{
    real v = uniform_between_signs(key, (uint32_t)piece + 1);
    real below = (v + 1) * (real)0.5, negative = heights->negative;
    if (below < negative) v = 2 * fused(below / negative, 1 - negative, negative) - 1;
    return larger(fused(inverse_erf(v), heights->sigma * SQRT2, heights->mean),
                  (real)LOWEST_HEIGHT);
}

/* The two edges of each piece's pulse, eqs 9-14 and 17. */
static void add_pulses(product_model_state *state, const product_model_parameters *p,
                       const uint32_t key[2], int32_t pieces)
{
    real gravity = (real)p->gravity, mass = (real)p->m_piece, length = (real)p->dt_impact;
    real start = (real)p->start, per_second = 1 / state->sample, weight = mass * gravity;
    real earliest = p->form == PRODUCT_MODEL_SMOOTH ? -(REACH * state->width + 4) : 0;
    height_distribution heights = heights_of(p, key);
    int32_t piece;
    for (piece = 0; piece < pieces; piece++) {
        real time = root(drop_height(&heights, key, piece) * 2 / gravity);
        real force = mass * (gravity * time) / length;
        add_edge(state, larger((time - start) * per_second, earliest), force);
        add_edge(state, larger(((time + length) - start) * per_second, earliest), weight - force);
    }
}

#if PRODUCT_MODEL_MAX_IMPACTS > 0

/* ---- a portion of the extended model: product_model/extended.py ---- */

#define MOST_REBOUND    ((real)0.9)     /* of the speed */
#define MOST_NORMAL     ((real)4)       /* in standard deviations of a moment of release */
#define LEADING         (1 / 0.33)      /* over the share whose pulse has the length dt_impact */
#define LEADING_OFFSET  ((real)0.03)    /* added to every share */
#define TRAILING        (1 / 0.033)     /* the same of late_duration */
#define TRAILING_OFFSET ((real)0.004)

/* The random numbers of one piece beside that of its drop height; product_model.landing_numbers. */
typedef struct {
    const uint32_t *key;
    uint32_t first;  /* number of the first one */
    int32_t flights; /* landings but one */
    int32_t gaps;    /* impacts but one of each landing */
} piece_numbers;

static real number_between_signs(const piece_numbers *numbers, int32_t index)
{
    return uniform_between_signs(numbers->key, numbers->first + (uint32_t)index);
}

/* Exponential number of mean 1. */
static real exponential(const piece_numbers *numbers, int32_t index)
{
    real half = (number_between_signs(numbers, index) + 1) * (real)0.5;
    return SINGLE ? -log_single(half) : -(real)log(half);
}

static real power(real base, real exponent)
{
    return SINGLE ? (real)powf((float)base, (float)exponent) : (real)pow(base, exponent);
}

/* exp(x), |x| < 87, in single precision (Cephes). */
static real exp_single(real x)
{
    static const double series[] = {
        0.000198756912, 0.00139819994, 0.00833345205, 0.0416657962, 0.166666657, 0.5};
    real whole = (real)floor((double)fused(x, (real)1.44269502, (real)0.5)), rest;
    rest = fused(whole, (real)0.000212194442, fused(whole, (real)-0.693359375, x));
    rest = fused(polynomial(series, 6, rest), rest * rest, rest) + 1;
    return (real)ldexp((double)rest, (int)whole);
}

/* tanh(x), |x| < 7, in single precision as XLA has it. */
static real tanh_single(real x)
{
    static const double over[] = {
        -2.76076837e-16, 2.00018794e-13, -8.60467184e-11, 5.12229725e-08, 1.48572235e-05,
        0.000637261954, 0.00489352457};
    static const double under[] = {
        1.19825836e-06, 0.000118534706, 0.00226843474, 0.00489352504};
    if (fabs((double)x) < (double)(real)4e-4) return x;
    return x * polynomial(over, 7, x * x) / polynomial(under, 4, x * x);
}

/* exp(x) - 1, |x| <= 20 */
static real exp_minus_one(real x)
{
    if (!SINGLE) return (real)expm1(x);
    if (x > (real)0.5 || x < (real)-0.5) return exp_single(x) - 1;
    return x == 0 ? x : tanh_single(x * (real)0.5) * (exp_single(x) + 1);
}

/* Number of impacts of a piece, at most one more than there is room for; 0: the paper's model. */
static int32_t impacts_of(const product_model_parameters *p)
{
    int32_t impacts = 0, j;
    if (p->landings.landings > PRODUCT_MODEL_MAX_IMPACTS) return PRODUCT_MODEL_MAX_IMPACTS + 1;
    for (j = 0; j < p->landings.landings; j++) {
        if (p->landings.impacts[j] > PRODUCT_MODEL_MAX_IMPACTS - impacts)
            return PRODUCT_MODEL_MAX_IMPACTS + 1;
        impacts += p->landings.impacts[j];
    }
    return impacts;
}

static int is_within(double x, double low, double high) { return x >= low && x < high; }

static int are_landings_allowed(const product_model_parameters *p)
{
    const product_model_landings *l = &p->landings;
    int32_t j;
    if (l->landings == 0) return 1;
    for (j = 0; j < l->landings && j < PRODUCT_MODEL_MAX_IMPACTS; j++)
        if (l->impacts[j] < 1) return 0;
    return l->landings > 0 && is_within(l->pulse_exponent, 0, 5) &&
           is_within(l->late_duration, 1e-6, 1) && is_within(l->share_exponent, 0, 100) &&
           is_within(l->impact_delay, 0, 1) && is_within(l->rebound, 0, 1) &&
           is_within(l->slump_depth, 0, 1) && is_within(l->early_weight, 0, 1) &&
           is_within(l->release_time, 0, 1) && is_within(l->release_skew, -5, 5) &&
           is_within(l->release_order, 0, 1) && is_within(l->cushioning, -5, 10) &&
           (l->shape == PRODUCT_MODEL_TRIANGLE || l->shape == PRODUCT_MODEL_RECTANGLE);
}

static double probability_below(double z) { return 0.5 * erfc(-z / 1.4142135623730951); }

/* 2 Phi(z), |z| <= 4, Phi the normal distribution; in single precision as XLA has it (Cephes). */
static real twice_probability_below(real z)
{
    static const double central[] = {
        7.85386146e-05, -0.000801019371, 0.00518832775, -0.0268538129, 0.112835854, -0.37612626,
        1.12837911};
    static const double middle[] = {
        0.0232682, -0.138703942, 0.368742466, -0.582473278, 0.621000469, -0.494451523, 0.340488,
        -0.274112701, 0.563825965};
    static const double tail[] = {
        -10.477664, 12.9772, -7.49551868, 2.92101908, -1.01526523, 0.42184633, -0.282076746,
        0.564189494};
    real w = z * (real)0.707106769, size = (real)fabs((double)w), square = w * w, inverse, beyond;
    if (!SINGLE) return (real)(2 * probability_below(z));
    if (size < (real)0.707106769) return error_function(w) + 1;
    inverse = 1 / square;
    if (size < 1)
        beyond = fused(-size, polynomial(central, 7, square), 1);
    else
        beyond = exp_single(-square) * (1 / size) *
                 (size < 2 ? polynomial(middle, 9, inverse) : polynomial(tail, 8, inverse));
    return w > 0 ? 2 - beyond : beyond;
}

/* Standard normal quantile of (index + 1/2) / pieces; one step of Newton's method in double
   precision. */
static double normal_score(int32_t index, int32_t pieces)
{
    int32_t lower = index < pieces - 1 - index ? index : pieces - 1 - index;
    double probability = (lower + 0.5) / pieces, z;
    if (2 * lower + 1 == pieces) return 0;
    z = (double)(inverse_erf((real)(2 * probability - 1)) * SQRT2);
    z -= (probability_below(z) - probability) * exp(0.5 * z * z) * 2.5066282746310002;
    return index == lower ? z : -z;
}

/* Over the standard deviation of the normal scores of a portion. */
static double score_scale(int32_t pieces)
{
    double sum = 0;
    int32_t k;
    for (k = 0; k < pieces / 2; k++) sum += 2 * normal_score(k, pieces) * normal_score(k, pieces);
    return pieces > 1 ? 1 / sqrt(sum / pieces) : 1;
}

static void add_pulse(product_model_state *state, double position, real length, real force)
{
    product_model_pulse *pulse = &state->pulses[state->pulse_count++];
    int is_far = !(fabs(position) < FAR);
    double whole = floor(position);
    pulse->whole = !is_far ? (int32_t)whole : position < 0 ? -FAR : FAR;
    pulse->fraction = !is_far ? (real)(position - whole) : 0;
    pulse->length = length;
    pulse->force = force;
}

/* The same for a beginning and a length in seconds. Beginnings are divided in double precision,
   which the slopes of triangles need; those of rectangles are rounded like edges. */
static void add_pulse_at(product_model_state *state, const product_model_parameters *p, real time,
                         real duration, real force)
{
    real start = (real)p->start, per_second = 1 / state->sample, begin, end;
    if (p->landings.shape == PRODUCT_MODEL_TRIANGLE) {
        add_pulse(state, ((double)time - p->start) / p->sample,
                  (real)((double)duration / p->sample), force);
    } else {
        begin = (time - start) * per_second;
        end = (time + duration - start) * per_second;
        add_pulse(state, begin, end - begin, force);
    }
}

/* A piece in free fall or on its flaps. */
typedef struct {
    real speed;   /* (m/s) at this landing */
    real again;   /* (m/s) with which it leaves it */
    real landing; /* (s)   moment of this landing */
    real delay;   /* (s)   mean time between its impacts */
    int32_t used; /*       impacts but one of each landing so far */
} falling_piece;

/* The impacts of landing j of a piece. */
static void add_impacts(product_model_state *state, const product_model_parameters *p,
                        const piece_numbers *numbers, falling_piece *piece, int32_t j)
{
    const product_model_landings *l = &p->landings;
    real mass = (real)p->m_piece, reference = root(2 * (real)p->gravity * (real)p->h_mean);
    real length = j == 0 ? (real)p->dt_impact : (real)l->late_duration;
    real offset = j == 0 ? LEADING_OFFSET : TRAILING_OFFSET, left = 1, later = 0;
    int32_t shares = 1 + 2 * numbers->flights + piece->used, k, count = l->impacts[j];
    for (k = 0; k < count; k++) {
        real rest = 0, momentum, duration;
        if (k < count - 1) {
            real half = (number_between_signs(numbers, shares + k) + 1) * (real)0.5;
            rest = left * power(half, (real)l->share_exponent);
        }
        momentum = (piece->speed + piece->again) * (left - rest);
        duration = length * power((momentum / reference + offset) *
                                      (j == 0 ? (real)LEADING : (real)TRAILING),
                                  (real)l->pulse_exponent);
        add_pulse_at(state, p, piece->landing + later, duration, mass * momentum / duration);
        left = rest;
        if (k < count - 1)
            later += piece->delay * exponential(numbers, shares + numbers->gaps + k) *
                     (real)(k < 1 ? 2 : k + 1);
    }
    piece->used += count - 1;
}

/* From landing j to the next one: up with the speed `again`, then down to a random depth. */
static void fly(const product_model_landings *l, const piece_numbers *numbers, falling_piece *piece,
                real less, int32_t j)
{
    real slump = exponential(numbers, 1 + numbers->flights + j);
    real depth = (real)l->slump_depth * (slump * slump * slump);
    piece->speed = root(fused(piece->again, piece->again, depth * (less * (real)(1.0 / 3.0))));
    piece->landing += (piece->again + piece->speed) / less;
}

/* Moment of release of a normal number, over release_time, and the mean time between the impacts
   (s). */
static real release_moment(const product_model_landings *l, real normal, double score, real *delay)
{
    real order = (real)l->release_order, skew = (real)l->release_skew, z, skewed;
    z = fused(order, (real)score, normal * (root(fused(-order, order, 1)) * SQRT2));
    z = z > MOST_NORMAL ? MOST_NORMAL : larger(z, -MOST_NORMAL);
    skewed = fabs((double)skew) > (double)(real)1e-3 ? exp_minus_one(skew * z) / skew
                                                     : z * fused((real)0.5 * skew, z, 1);
    *delay = (real)l->impact_delay * power(twice_probability_below(z) + (real)0.02,
                                           (real)l->cushioning);
    return skewed;
}

/* The impacts of all pieces, and their weight in two steps each. */
static void add_landings(product_model_state *state, const product_model_parameters *p,
                         const uint32_t key[2], int32_t pieces)
{
    const product_model_landings *l = &p->landings;
    real gravity = (real)p->gravity, less = (1 - (real)l->early_weight) * gravity;
    real mass = (real)p->m_piece, dt_impact = (real)p->dt_impact, start = (real)p->start;
    real per_second = 1 / state->sample;
    real earliest = p->form == PRODUCT_MODEL_SMOOTH ? -(REACH * state->width + 4) : 0;
    double scale = score_scale(pieces);
    height_distribution heights = heights_of(p, key);
    int32_t i, j, flights = l->landings - 1, gaps = impacts_of(p) - l->landings;
    state->shape = l->shape;
    for (i = 0; i < pieces; i++) {
        piece_numbers numbers;
        falling_piece piece;
        real fall = root(drop_height(&heights, key, i) * 2 / gravity), touch;
        numbers.key = key;
        numbers.first = 1 + (uint32_t)pieces + (uint32_t)i * (uint32_t)(1 + 2 * (flights + gaps));
        numbers.flights = flights;
        numbers.gaps = gaps;
        piece.used = 0;
        touch = release_moment(l, inverse_erf(number_between_signs(&numbers, 0)),
                               scale * normal_score(i, pieces), &piece.delay);
        touch = fused((real)l->release_time, touch, fall);
        piece.speed = gravity * fall;
        piece.landing = touch;
        for (j = 0; j <= flights; j++) {
            real share = j == flights ? 0 : (real)l->rebound * exponential(&numbers, 1 + j);
            piece.again = (share < MOST_REBOUND ? share : MOST_REBOUND) * piece.speed;
            add_impacts(state, p, &numbers, &piece, j);
            if (j < flights) fly(l, &numbers, &piece, less, j);
        }
        add_edge(state, larger((touch + dt_impact - start) * per_second, earliest),
                 mass * (gravity - less));
        add_edge(state, larger((piece.landing + dt_impact - start) * per_second, earliest),
                 mass * less);
    }
}

/* ---- the heap of pulses ---- */

static int begins_earlier(const product_model_pulse *a, const product_model_pulse *b)
{
    return a->whole < b->whole || (a->whole == b->whole && a->fraction < b->fraction);
}

static void swap_pulses(product_model_pulse *a, product_model_pulse *b)
{
    product_model_pulse kept = *a;
    *a = *b;
    *b = kept;
}

static void sift_pulse_down(product_model_pulse *heap, int32_t size, int32_t parent)
{
    for (;;) {
        int32_t child = 2 * parent + 1;
        if (child >= size) return;
        if (child + 1 < size && begins_earlier(&heap[child + 1], &heap[child])) child++;
        if (!begins_earlier(&heap[child], &heap[parent])) return;
        swap_pulses(&heap[child], &heap[parent]);
        parent = child;
    }
}

static void clear_pulses(product_model_state *state) { state->pulse_count = 0; }

static void reset_pulses(product_model_state *state)
{
    int32_t parent;
    state->pulses_waiting = state->pulses_unfinished = state->pulse_count;
    for (parent = state->pulse_count / 2 - 1; parent >= 0; parent--)
        sift_pulse_down(state->pulses, state->pulse_count, parent);
}

#else

static int32_t impacts_of(const product_model_parameters *p) { return (void)p, 0; }
static int are_landings_allowed(const product_model_parameters *p) { return (void)p, 1; }
static void clear_pulses(product_model_state *state) { (void)state; }
static void reset_pulses(product_model_state *state) { (void)state; }
static void add_landings(product_model_state *state, const product_model_parameters *p,
                         const uint32_t key[2], int32_t pieces)
{
    (void)state, (void)p, (void)key, (void)pieces;
}

#endif

int product_model_start_with_key(product_model_state *state,
                                 const product_model_parameters *parameters, const uint32_t key[2],
                                 double target)
{
    int32_t pieces;
    state->count = 0;
    clear_pulses(state);
    state->sample = 1;
    state->form = PRODUCT_MODEL_INTERVAL_MEAN;
    product_model_reset(state);
    if (!are_allowed(parameters) || !are_landings_allowed(parameters) ||
        !(target >= 0 && target <= DBL_MAX))
        return PRODUCT_MODEL_BAD_PARAMETER;
    if (impacts_of(parameters) > PRODUCT_MODEL_MAX_IMPACTS) return PRODUCT_MODEL_TOO_MANY_IMPACTS;
    pieces = number_of_pieces(parameters, target);
    if (pieces > PRODUCT_MODEL_MAX_PIECES) return PRODUCT_MODEL_TOO_MANY_PIECES;
    state->sample = (real)parameters->sample;
    state->width = (real)(parameters->smooth_width / parameters->sample);
    state->form = parameters->form;
    if (impacts_of(parameters) > 0)
        add_landings(state, parameters, key, pieces);
    else
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
    reset_pulses(state);
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
    return samples_since(state, edge->whole, edge->fraction);
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

#if PRODUCT_MODEL_MAX_IMPACTS > 0

static real time_since_begin(const product_model_state *state, const product_model_pulse *pulse)
{
    return samples_since(state, pulse->whole, pulse->fraction);
}

static real smaller(real a, real b) { return a < b ? a : b; }

/* Force of a pulse at a time after its beginning, over its mean force. Times in samples. */
static real momentary_part(int32_t shape, real time, real length)
{
    if (time < 0 || time >= length) return 0;
    return shape == PRODUCT_MODEL_RECTANGLE ? 1 : 4 * smaller(time, length - time) / length;
}

/* Its mean from `begin` to `end`, over its mean force and without cancellation. */
static real mean_part(int32_t shape, real begin, real end, real length)
{
    real steps = end - begin, half = length / 2, from, to, area;
    from = larger(begin, 0);
    to = smaller(end, length);
    if (!(to > from)) return 0;
    if (shape == PRODUCT_MODEL_RECTANGLE) return (to - from) / steps;
    area = from < half ? (smaller(to, half) - from) * (smaller(to, half) + from) : 0;
    from = length - larger(from, half);
    to = length - to;
    if (from > to) area += (from - to) * (from + to);
    return area / half / steps;
}

/* What a Gaussian of unit width adds to the integral of a step (rectangle) and of a ramp
   (triangle): what is left of them when the sharp ones are taken away. */
static double blur(int32_t shape, double u)
{
    double below = -fabs(u), density = exp(-0.5 * u * u) / 2.5066282746310002, part;
    if (shape == PRODUCT_MODEL_RECTANGLE) return below * probability_below(below) + density;
    part = 0.5 * ((u * u + 1) * probability_below(below) + below * density);
    return u > 0 ? 0.5 - part : part;
}

/* What the Gaussian adds to the momentum of a pulse until a time after its beginning, over its mean
   force. width, time and length in samples. */
static double blurred_part(int32_t shape, double width, double time, double length)
{
    double u = time / width, v = (time - length) / width;
    if (shape == PRODUCT_MODEL_RECTANGLE) return width * (blur(shape, u) - blur(shape, v));
    return 4 * width * width / length *
           (blur(shape, u) - 2 * blur(shape, (time - length / 2) / width) + blur(shape, v));
}

static real pulse_part(const product_model_state *state, const product_model_pulse *pulse,
                       real steps)
{
    real end = time_since_begin(state, pulse), part;
    if (state->form == PRODUCT_MODEL_RECTANGULAR)
        return momentary_part(state->shape, end, pulse->length);
    part = mean_part(state->shape, end - steps, end, pulse->length);
    if (state->form == PRODUCT_MODEL_SMOOTH)
        part += (real)((blurred_part(state->shape, state->width, end, pulse->length) -
                        blurred_part(state->shape, state->width, end - steps, pulse->length)) /
                       steps);
    return part;
}

/* The force of the pulses that act in the time step; `ahead` as in product_model_step. */
static real pulse_force(product_model_state *state, real ahead, real steps)
{
    double force = 0;
    int32_t k;
    while (state->pulses_waiting > 0 && time_since_begin(state, &state->pulses[0]) >= ahead) {
        state->pulses_waiting--;
        swap_pulses(&state->pulses[0], &state->pulses[state->pulses_waiting]);
        sift_pulse_down(state->pulses, state->pulses_waiting, 0);
    }
    for (k = state->pulses_unfinished - 1; k >= state->pulses_waiting; k--) {
        product_model_pulse *pulse = &state->pulses[k];
        force += (double)(pulse->force * pulse_part(state, pulse, steps));
        if (time_since_begin(state, pulse) - pulse->length >= -ahead)
            swap_pulses(pulse, &state->pulses[--state->pulses_unfinished]);
    }
    return (real)force;
}

/* Whether nothing changes any more. */
static int is_over(const product_model_state *state)
{
    return state->unfinished == 0 && state->pulses_unfinished == 0;
}

/* Number of the sample in which the next edge or pulse lies; the present one while a pulse acts. */
static int32_t next_change(const product_model_state *state)
{
    int32_t next = state->waiting > 0 ? state->edges[0].whole : FAR;
    if (state->pulses_unfinished > state->pulses_waiting) return state->whole;
    if (state->pulses_waiting > 0 && state->pulses[0].whole < next) next = state->pulses[0].whole;
    return next;
}

#else

static real pulse_force(product_model_state *state, real ahead, real steps)
{
    return (void)state, (void)ahead, (void)steps, (real)0;
}
static int is_over(const product_model_state *state) { return state->unfinished == 0; }
static int32_t next_change(const product_model_state *state) { return state->edges[0].whole; }

#endif

product_model_real product_model_step(product_model_state *state, product_model_real dt)
{
    real before = state->level + state->level_error;
    real ahead = state->form == PRODUCT_MODEL_SMOOTH ? -REACH * state->width : 0;
    if (is_over(state) || !(dt > 0)) return before;
    if (dt != state->dt) set_step(state, dt);
    advance_time(state);
    while (state->waiting > 0 && time_since(state, &state->edges[0]) >= ahead) pop_edge(state);
    before += pulse_force(state, ahead, state->steps);
    if (state->unfinished == state->waiting) return before;
    return before + unfinished_force(state, state->steps);
}

/* Number of coming time steps, at most `count`, in which certainly no edge acts in part. */
static int32_t count_quiet_steps(const product_model_state *state, int32_t count)
{
    int32_t quiet;
    if (is_over(state)) return count;
    if (state->unfinished > state->waiting || state->form == PRODUCT_MODEL_SMOOTH) return 0;
    if (state->step_fraction > 0 || state->step_whole == 0) return 0;
    quiet = (next_change(state) - 1 - state->whole) / state->step_whole;
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
        if (!is_over(state)) state->whole += quiet * state->step_whole;
        done += quiet;
        if (done < count) forces[done++] = product_model_step(state, dt);
    }
}
