"""Studies: a scene with parameters that vary, seeds at each point, outputs with their bands, one
table and one figure.
"""
