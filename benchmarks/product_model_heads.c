/* CPU time of heads of a scale, each of which lets a portion fall every second, one head after the
   other. Words: number of heads, time step (s), simulated seconds. Prints simulated time over CPU
   time, first with a call for each step and head, then with a call for each second and head. */

#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "product_model.h"
#include "product_model_parameters.h"

#define MOST_HEADS 20
#define MOST_STEPS 100000 /* in a second */

static product_model_state states[MOST_HEADS];
static product_model_real forces[MOST_STEPS];

static double seconds_since(clock_t begin) { return (double)(clock() - begin) / CLOCKS_PER_SEC; }

int main(int count, char **words)
{
    product_model_parameters parameters = PRODUCT_MODEL_PARAMETERS;
    int heads = count > 1 ? atoi(words[1]) : MOST_HEADS, head;
    double step = count > 2 ? atof(words[2]) : 1e-3;
    long seconds = count > 3 ? atol(words[3]) : 100, steps = (long)(1 / step + 0.5), second, k;
    volatile double last = 0; /* so that nothing is left out */
    clock_t begin = clock();
    uint32_t seed = 0;
    if (heads > MOST_HEADS || steps > MOST_STEPS) return 1;
    for (second = 0; second < seconds; second++)
        for (k = 0; k < steps; k++)
            for (head = 0; head < heads; head++) {
                if (k == head * steps / heads)
                    product_model_start(&states[head], &parameters, seed++, 0.0);
                last = product_model_step(&states[head], (product_model_real)step);
            }
    printf("%.6g ", (double)seconds / seconds_since(begin));
    begin = clock();
    for (second = 0; second < seconds; second++)
        for (head = 0; head < heads; head++) {
            product_model_start(&states[head], &parameters, seed++, 0.0);
            product_model_steps(&states[head], (product_model_real)step, forces, (int32_t)steps);
            last = forces[steps - 1];
        }
    printf("%.6g\n", (double)seconds / seconds_since(begin));
    return last < 0;
}
