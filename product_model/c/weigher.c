/* See weigher.h. The names are those of product_model/weigher.py. */

#include "weigher.h"

#include <math.h>
#include <string.h>

#include "weigher_data.h"

#define SIZE WEIGHER_SIZE
#define MOVING 5 /* unknowns that change from sample to sample: XI to LINE + 1 */

enum { XI, ETA, RHO, LINE, TARE = 5, KAPPA, LAMBDA, TOTAL, SHAPES };

static const double CAP = 100.0, QUIET_SAMPLES = 6, EMPTY_AFTER = 0.1, STILL = 0.05, WARM_UP = 0.03;
static const double STEP = 1e-4, LIMIT = 0.5, CLEAR = 4.0, DOUBTED = 4.0;
static const double AMPLITUDE_FREEDOM = 4.0;
static const double SD_OF_99_PERCENT = 3.250208668254262; /* t of 4 degrees of freedom */

static double largest(double a, double b) { return a > b ? a : b; }
static double within(double x, double low, double high)
{
    return x < low ? low : x > high ? high : x;
}

/* ---- the load cell ---- */

typedef struct {
    double e00, e01, e10, e11, g0, g1;
} cell;

static cell cell_step(double omega2, double delta)
{
    double h = DATA_INTERVAL, turn = sqrt(omega2 - delta * delta), shrink = exp(-delta * h);
    double cosine = shrink * cos(turn * h), sine = shrink * sin(turn * h) / turn;
    cell c;
    c.e00 = cosine + delta * sine;
    c.e01 = omega2 * sine;
    c.e10 = -sine;
    c.e11 = cosine - delta * sine;
    c.g0 = (1 - c.e11 - 2 * delta * sine) / h;
    c.g1 = sine / h;
    return c;
}

/* Slopes of xi and eta with the logarithm of omega^2 or delta. */
static void find_slope(cell high, cell low, const double mean[], double impulse, double slope[2])
{
    double twice = 2 * STEP;
    slope[0] = (high.e00 - low.e00) / twice * mean[XI] + (high.e01 - low.e01) / twice * mean[ETA] +
               (high.g0 - low.g0) / twice * impulse;
    slope[1] = (high.e10 - low.e10) / twice * mean[XI] + (high.e11 - low.e11) / twice * mean[ETA] +
               (high.g1 - low.g1) / twice * impulse;
}

/* The step of the cell with the pieces that lie on it, and the slopes of xi and eta with kappa,
   lambda and the weight. */
static cell loaded_cell(const double mean[], double landed, double impulse, double slopes[2][3])
{
    double load = within(mean[TOTAL], 0.0, 10 * DATA_MASS) * landed;
    double share = DATA_MASS / (DATA_MASS + load), by_load = -landed / (DATA_MASS + load);
    double stiffer = 1 + within(mean[KAPPA], -LIMIT, LIMIT);
    double damped = 1 + within(mean[LAMBDA], -LIMIT, LIMIT);
    double omega2 = DATA_OMEGA * DATA_OMEGA * stiffer * share, delta = DATA_DELTA * damped * share;
    double by_omega[2], by_delta[2];
    int k;
    find_slope(cell_step(omega2 * (1 + STEP), delta), cell_step(omega2 * (1 - STEP), delta), mean,
               impulse, by_omega);
    find_slope(cell_step(omega2, delta * (1 + STEP)), cell_step(omega2, delta * (1 - STEP)), mean,
               impulse, by_delta);
    for (k = 0; k < 2; k++) {
        slopes[k][0] = by_omega[k] / stiffer;
        slopes[k][1] = by_delta[k] / damped;
        slopes[k][2] = (by_omega[k] + by_delta[k]) * by_load;
    }
    return cell_step(omega2, delta);
}

/* ---- the unknowns of an empty scale and of a portion ---- */

static void start_covariance(double covariance[SIZE][SIZE])
{
    double a = DATA_LINE[0], b = DATA_LINE[1], kick = DATA_KICK / DATA_OMEGA;
    double line = (1 - b) * DATA_LINE_INNOVATION * DATA_LINE_INNOVATION /
                  ((1 + b) * ((1 - b) * (1 - b) - a * a));
    memset(covariance, 0, SIZE * sizeof covariance[0]);
    covariance[XI][XI] = covariance[TARE][TARE] = DATA_KICK * DATA_KICK;
    covariance[ETA][ETA] = kick * kick;
    covariance[LINE][LINE] = covariance[LINE + 1][LINE + 1] = line;
    covariance[LINE][LINE + 1] = covariance[LINE + 1][LINE] = line * a / (1 - b);
}

static void add_portion(double covariance[SIZE][SIZE])
{
    double below = DATA_LEVEL * DATA_LEVEL;
    int k;
    covariance[XI][XI] += below;
    covariance[ETA][ETA] += 0.1 * below / (DATA_OMEGA * DATA_OMEGA);
    covariance[RHO][RHO] += DATA_RESIDUAL[0] * DATA_RESIDUAL[0];
    covariance[KAPPA][KAPPA] += DATA_STIFFNESS_SD * DATA_STIFFNESS_SD;
    covariance[LAMBDA][LAMBDA] += DATA_DAMPING_SD * DATA_DAMPING_SD;
    covariance[TOTAL][TOTAL] += DATA_WEIGHT * DATA_WEIGHT;
    for (k = SHAPES; k < SIZE; k++) covariance[k][k] += 1.0;
}

void weigher_start(weigher_state *state)
{
    int k;
    memset(state, 0, sizeof *state);
    start_covariance(state->covariance);
    state->row = -1;
    for (k = 0; k < 3; k++) state->check[k] = 1.0;
}

double weigher_interval(void) { return DATA_INTERVAL; }

/* The tare of the first sample, and the prior of a portion where a sample triggers. */
static void begin_sample(weigher_state *s, double sample)
{
    cell c = cell_step(DATA_OMEGA * DATA_OMEGA, DATA_DELTA);
    double eta, line, expected;
    if (s->count == 0) s->origin = s->mean[TARE] = sample;
    eta = c.e10 * s->mean[XI] + c.e11 * s->mean[ETA];
    line = DATA_LINE[0] * s->mean[LINE] + DATA_LINE[1] * s->mean[LINE + 1];
    expected = (s->mean[ETA] - eta) / DATA_INTERVAL + s->mean[TARE] + line;
    if (s->count < WARM_UP / DATA_INTERVAL) {
        s->count += 1;
        return;
    }
    if (s->row >= 0 || !(sample - expected > DATA_LEVEL)) return;
    s->tare = s->mean[TARE];
    s->mean[TOTAL] = DATA_WEIGHT;
    add_portion(s->covariance);
    s->row = 0;
    s->check[0] = s->check[2] = 1.0;
    s->check[1] = 1e-6;
    s->doubts = 0;
    s->calm = 0;
}

/* ---- a step of the filter of Kalman ---- */

typedef struct {
    double rows[6][SIZE]; /* by which xi, eta, rho, the line and the sample depend on the unknowns */
    double noise[6][6];
    double prior[6];
} dynamics;

static void fill_row(double row[], double e0, double e1, double gain, double keep, double tare,
                     const double slope[3], double impulse, const double shapes[], double active)
{
    int k;
    memset(row, 0, SIZE * sizeof row[0]);
    row[XI] = e0;
    row[ETA] = e1;
    row[RHO] = gain * (1 - keep);
    row[TARE] = tare;
    row[KAPPA] = slope[0];
    row[LAMBDA] = slope[1];
    row[TOTAL] = gain * impulse + slope[2];
    for (k = 0; k < WEIGHER_SHAPES; k++) row[SHAPES + k] = gain * active * shapes[k];
}

static void add_outer(double noise[6][6], double variance, const double vector[6])
{
    int i, k;
    for (i = 0; i < 6; i++)
        for (k = 0; k < 6; k++) noise[i][k] += variance * (vector[i] * vector[k]);
}

static void fill_noise(dynamics *d, const cell *c, double residual, double active, double pulse)
{
    double h = DATA_INTERVAL, omega2 = DATA_OMEGA * DATA_OMEGA;
    double of_residual[6] = { -c->g0, -c->g1, 1, 0, 0, (c->g1 - 1) / h };
    double of_shaking[6] = { omega2 * h / 2, 1, 0, 0, 0, -1 / h }, of_line[6] = { 0, 0, 0, 1, 0, 1 };
    double rate = active > 0 ? DATA_LOAD_RATE : DATA_KICK_RATE;
    double aa = omega2 * omega2 * h * h / 12, ab = -(omega2 * omega2) * h * h * h / 24;
    double bb = omega2 * omega2 * h * h * h * h / 45;
    memset(d->noise, 0, sizeof d->noise);
    add_outer(d->noise, residual, of_residual);
    add_outer(d->noise, rate * rate, of_shaking);
    add_outer(d->noise, DATA_LINE_INNOVATION * DATA_LINE_INNOVATION, of_line);
    d->noise[5][5] += DATA_WHITE * DATA_WHITE;
    d->noise[0][0] += pulse * aa;
    d->noise[0][1] += pulse * ab;
    d->noise[1][0] += pulse * ab;
    d->noise[1][1] += pulse * bb;
    d->noise[0][5] += pulse * (-ab / h);
    d->noise[5][0] += pulse * (-ab / h);
    d->noise[1][5] += pulse * (-bb / h);
    d->noise[5][1] += pulse * (-bb / h);
    d->noise[5][5] += pulse * (bb / (h * h));
}

static void predict(const weigher_state *s, dynamics *d)
{
    int row = s->row > 0 ? s->row : 0, k, i;
    double h = DATA_INTERVAL, active = s->row >= 0 ? 1.0 : 0.0;
    double residual = DATA_RESIDUAL[row], before = DATA_RESIDUAL[row > 0 ? row - 1 : 0];
    double keep = DATA_RESIDUAL_DECAY * residual / before * active;
    double impulse = active * DATA_IMPULSE[row], given = (1 - keep) * s->mean[RHO], slopes[2][3];
    double sample_slope[3], shift[6] = { 0, 0, 0, 0, 0, 0 };
    const double none[3] = { 0, 0, 0 }, *shapes = DATA_SHAPES[row];
    cell c;
    given += impulse * s->mean[TOTAL];
    for (k = 0; k < WEIGHER_SHAPES; k++) given += active * shapes[k] * s->mean[SHAPES + k];
    c = loaded_cell(s->mean, active * DATA_LANDED[row], given, slopes);
    for (k = 0; k < 3; k++) sample_slope[k] = -slopes[1][k] / h;
    fill_row(d->rows[0], c.e00, c.e01, c.g0, keep, 0, slopes[0], impulse, shapes, active);
    fill_row(d->rows[1], c.e10, c.e11, c.g1, keep, 0, slopes[1], impulse, shapes, active);
    for (k = 2; k < 5; k++) fill_row(d->rows[k], 0, 0, 0, 0, 0, none, 0, shapes, active);
    fill_row(d->rows[5], -c.e10 / h, (1 - c.e11) / h, (1 - c.g1) / h, keep, 1, sample_slope,
             impulse, shapes, active);
    d->rows[2][RHO] = keep;
    d->rows[4][LINE] = 1.0;
    for (k = 0; k < 2; k++) d->rows[3][LINE + k] = d->rows[5][LINE + k] = DATA_LINE[k];
    shift[0] = s->mean[TOTAL] * slopes[0][2];
    shift[1] = s->mean[TOTAL] * slopes[1][2];
    shift[5] = s->mean[TOTAL] * sample_slope[2];
    for (i = 0; i < 6; i++) {
        double total = 0;
        for (k = 0; k < SIZE; k++)
            if (k != KAPPA && k != LAMBDA) total += d->rows[i][k] * s->mean[k];
        d->prior[i] = total - shift[i];
    }
    fill_noise(d, &c, (1 - DATA_RESIDUAL_DECAY * DATA_RESIDUAL_DECAY) * residual * residual * active,
               active, active * DATA_PULSE[row] * DATA_PULSE[row]);
}

/* The squared normalized innovation of a sample, with which mean and covariance are updated. */
static double update(weigher_state *s, const dynamics *d, double sample)
{
    double ahead[6][SIZE], inner[6][6], cross[SIZE], variance, off;
    int i, j, k;
    memset(ahead, 0, sizeof ahead);
    for (i = 0; i < 6; i++)
        for (j = 0; j < SIZE; j++)
            if (d->rows[i][j] != 0)
                for (k = 0; k < SIZE; k++) ahead[i][k] += d->rows[i][j] * s->covariance[j][k];
    for (i = 0; i < 6; i++)
        for (j = 0; j < 6; j++) {
            inner[i][j] = d->noise[i][j];
            for (k = 0; k < SIZE; k++) inner[i][j] += ahead[i][k] * d->rows[j][k];
        }
    variance = largest(inner[5][5], DATA_WHITE * DATA_WHITE);
    off = sample - d->prior[5];
    for (k = 0; k < SIZE; k++) cross[k] = k < MOVING ? inner[5][k] : ahead[5][k];
    for (k = 0; k < SIZE; k++)
        s->mean[k] = (k < MOVING ? d->prior[k] : s->mean[k]) + cross[k] * (off / variance);
    for (i = 0; i < MOVING; i++)
        for (k = 0; k < SIZE; k++)
            s->covariance[i][k] = s->covariance[k][i] = k < MOVING ? inner[i][k] : ahead[i][k];
    for (i = 0; i < SIZE; i++)
        for (k = 0; k < SIZE; k++) s->covariance[i][k] -= cross[i] * (cross[k] / variance);
    return off * off / variance;
}

/* ---- the filter that stands in, and the checks ---- */

/* The reading (g) of the filter, with the tare. */
static double filter_sample(weigher_state *s, double sample)
{
    double value = sample - s->origin, keep = exp(-DATA_INTERVAL / STILL), reading, off;
    int k;
    for (k = 0; k < WEIGHER_SECTIONS; k++) {
        const double *c = DATA_SECTIONS[k];
        double *memory = s->memory[k], out = c[0] * value + memory[0];
        memory[0] = c[1] * value - c[4] * out + memory[1];
        memory[1] = c[2] * value - c[5] * out;
        value = out;
    }
    reading = value + s->origin;
    off = reading - (s->count == 1 ? reading : s->filter_mean);
    s->filter_mean = reading - keep * off;
    s->filter_variance = keep * (s->filter_variance + (1 - keep) * off * off);
    return reading;
}

static double widened_sd(const weigher_state *s, int row)
{
    double variance = largest(s->covariance[TOTAL][TOTAL], 0.0);
    int k;
    for (k = 1; k < 3; k++) variance *= largest(s->check[k] / exp(DATA_CHECK_MEAN[row][k]), 1.0);
    return sqrt(variance) * DATA_WIDENING[row];
}

static void update_checks(weigher_state *s, double innovation)
{
    double part = innovation < CAP ? innovation : CAP, samples = s->row + QUIET_SAMPLES;
    double shown = 0, known = 0;
    int k;
    for (k = SHAPES; k < SIZE; k++) {
        shown += s->mean[k] * s->mean[k];
        known += 1 - s->covariance[k][k];
    }
    s->check[0] = DATA_CHECK_DECAY * s->check[0] + (1 - DATA_CHECK_DECAY) * part;
    s->check[1] = (samples * s->check[1] + part) / (samples + 1);
    s->check[2] = (AMPLITUDE_FREEDOM + shown) / (AMPLITUDE_FREEDOM + known);
}

static void raise_doubts(weigher_state *s, double innovation, double filtered)
{
    int row = s->row, k;
    double grams = s->mean[TOTAL], sd, scatter, apart;
    if (row < 0) return;
    update_checks(s, innovation);
    for (k = 0; k < 3; k++)
        if ((log(s->check[k]) - DATA_CHECK_MEAN[row][k]) / DATA_CHECK_SD[row][k] > DATA_THRESHOLD[k])
            s->doubts |= WEIGHER_SIGNAL;
    sd = widened_sd(s, row);
    if (grams - CLEAR * sd > DATA_MOST || grams + CLEAR * sd < DATA_LEAST)
        s->doubts |= WEIGHER_WEIGHT;
    scatter = s->doubts & WEIGHER_SIGNAL ? 0 : s->filter_variance;
    apart = CLEAR * sqrt(sd * sd + DATA_FILTER_SD[row] * DATA_FILTER_SD[row] + scatter);
    if (row >= DATA_SETTLED && fabs(filtered - s->tare - grams) > apart)
        s->doubts |= WEIGHER_FILTER;
}

static weigher_reading make_reading(const weigher_state *s, double filtered)
{
    weigher_reading r;
    double moving, estimated;
    int is_estimate;
    if (s->row < 0) {
        r.grams = filtered - s->mean[TARE];
        r.sd = sqrt(s->covariance[TARE][TARE]);
        r.believed = r.doubts = 0;
        r.status = WEIGHER_EMPTY;
        return r;
    }
    moving = sqrt(DATA_FILTER_SD[s->row] * DATA_FILTER_SD[s->row] + s->filter_variance);
    estimated = widened_sd(s, s->row) * (s->doubts ? DOUBTED : 1.0);
    is_estimate = !s->doubts || (s->doubts == WEIGHER_SIGNAL && estimated < moving);
    r.believed = !s->doubts;
    r.grams = is_estimate ? s->mean[TOTAL] : filtered - s->tare;
    r.sd = is_estimate ? estimated : moving;
    r.status = s->doubts ? WEIGHER_FALLBACK : WEIGHER_ESTIMATE;
    r.doubts = s->doubts;
    return r;
}

/* The next row, or an empty scale. */
static void finish_sample(weigher_state *s, double filtered)
{
    int is_near = s->row >= 0 && fabs(filtered - s->tare) < DATA_LEVEL;
    s->calm = is_near ? s->calm + 1 : 0;
    if (s->calm > EMPTY_AFTER / DATA_INTERVAL) {
        memset(s->mean, 0, sizeof s->mean);
        s->mean[TARE] = filtered;
        start_covariance(s->covariance);
        s->row = -1;
        s->calm = 0;
    } else if (s->row >= 0 && s->row < DATA_ROWS - 1) {
        s->row++;
    }
}

weigher_reading weigher_feed(weigher_state *state, double sample)
{
    dynamics d;
    double innovation, filtered;
    weigher_reading reading;
    begin_sample(state, sample);
    predict(state, &d);
    innovation = update(state, &d, sample);
    filtered = filter_sample(state, sample);
    raise_doubts(state, innovation, filtered);
    reading = make_reading(state, filtered);
    finish_sample(state, filtered);
    return reading;
}

int weigher_is_decided(const weigher_reading *reading, double tolerance)
{
    return reading->status != WEIGHER_EMPTY && SD_OF_99_PERCENT * reading->sd <= tolerance;
}
