/* Example: one portion as a table of times and forces on the standard output.

       ./example [SEED [SECONDS]] > portion.csv */

#include <stdio.h>
#include <stdlib.h>

#include "product_model.h"
#include "product_model_parameters.h"

static product_model_state state; /* of a fixed size: no memory is allocated */

int main(int count, char **words)
{
    product_model_parameters parameters = PRODUCT_MODEL_PARAMETERS;
    uint32_t seed = count > 1 ? (uint32_t)strtoul(words[1], NULL, 10) : PRODUCT_MODEL_SEED;
    double seconds = count > 2 ? strtod(words[2], NULL) : PRODUCT_MODEL_DURATION;
    long samples = (long)(seconds / parameters.sample * (1 - 1e-12)) + 1, k;
    int error = product_model_start(&state, &parameters, seed, 0.0);
    if (error) {
        fprintf(stderr, "product_model_start: error %d, see product_model.h\n", error);
        return 1;
    }
    printf("time_s,force_n\n");
    for (k = 1; k <= samples; k++) {
        double force = product_model_step(&state, (product_model_real)parameters.sample);
        printf("%.9g,%.9g\n", parameters.start + (double)k * parameters.sample, force);
    }
    return 0;
}
