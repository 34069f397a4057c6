/* The weight of a portion while it lands, in C99: the estimator of `calibrate weigher`, one sample of
   the load cell after the other. product_model/weigher.py and docs/theory.md describe it.

   Files: weigher.h, weigher.c and weigher_data.h (the data of one product on one scale); needs
   <math.h>, <stdint.h> and no other library; allocates no memory. The readings are those of
   `weigher.feed` in Python.

       static weigher_state state;              (one for each scale)
       weigher_start(&state);
       for (;;) reading = weigher_feed(&state, sample);      (g, with the tare)

   Compile without -ffast-math. */

#ifndef WEIGHER_H
#define WEIGHER_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define WEIGHER_SHAPES 0
#define WEIGHER_SECTIONS 0
#define WEIGHER_SIZE (9 + WEIGHER_SHAPES) /* unknowns */

/* What the reading is. */
enum { WEIGHER_EMPTY = 0, WEIGHER_ESTIMATE = 1, WEIGHER_FALLBACK = 2 };

/* Bits that say why it is a fallback. */
enum { WEIGHER_SIGNAL = 1, WEIGHER_WEIGHT = 2, WEIGHER_FILTER = 4 };

typedef struct {
    double grams;     /* net weight */
    double sd;        /* (g) its standard deviation */
    int32_t believed; /* 1: grams is the estimator's, without a doubt */
    int32_t status;   /* WEIGHER_EMPTY, WEIGHER_ESTIMATE or WEIGHER_FALLBACK */
    int32_t doubts;
} weigher_reading;

typedef struct {
    double mean[WEIGHER_SIZE];
    double covariance[WEIGHER_SIZE][WEIGHER_SIZE];
    double memory[WEIGHER_SECTIONS][2];
    double check[3];
    double tare, filter_mean, filter_variance, origin, calm, count;
    int32_t row; /* -1: empty */
    int32_t doubts;
} weigher_state;

/* An empty scale. */
void weigher_start(weigher_state *state);

/* The reading after one more sample (g), with the tare; samples have the interval of the file. */
weigher_reading weigher_feed(weigher_state *state, double sample);

/* Whether the error of a reading is within a tolerance (g) with a confidence of 99 %. */
int weigher_is_decided(const weigher_reading *reading, double tolerance);

/* (s) between samples. */
double weigher_interval(void);

#ifdef __cplusplus
}
#endif

#endif
