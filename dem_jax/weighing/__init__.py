"""From the force on a scale to the weight that it shows: readings at the scale's rate, a filter,
and the time to weigh.

Pure functions of arrays, the same for a run of pieces, for a trace of the Product Model and, block
by block, for a signal as it comes: a chain fed in parts gives the same bits as one call.
"""
