/* Copies of the values of a unit, which fmi2.c and fmi3.c give out as its state; after unit.h. */

/* A copy of all values in `state`, for which memory is taken where it has none. Returns NULL or what
   is wrong. */
static const char *keep_values(const void *values, void **state)
{
    if (!*state) *state = malloc(sizeof(unit_values));
    if (!*state) return "no memory for the state";
    memcpy(*state, values, sizeof(unit_values));
    return NULL;
}

static void free_values(void **state)
{
    if (!state) return;
    free(*state);
    *state = NULL;
}
