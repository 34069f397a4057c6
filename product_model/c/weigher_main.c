/* Example: samples of a load cell (g, with the tare), one in each line of the standard input, and for
   each a line with the net weight (g), its standard deviation (g), the status and the doubts.

       logger | ./example */

#include <stdio.h>

#include "weigher.h"

static weigher_state state; /* of a fixed size: no memory is allocated */

int main(void)
{
    double sample;
    long number;
    weigher_start(&state);
    printf("time_s,grams,sd_g,status,doubts\n");
    for (number = 0; scanf("%lf", &sample) == 1; number++) {
        weigher_reading reading = weigher_feed(&state, sample);
        printf("%.9g,%.12g,%.12g,%d,%d\n", (double)number * weigher_interval(), reading.grams,
               reading.sd, (int)reading.status, (int)reading.doubts);
        fflush(stdout);
    }
    return 0;
}
