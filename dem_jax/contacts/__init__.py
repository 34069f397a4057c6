"""From two bodies to a force: materials, geometry, contact law, sums over contacts; walls in
motion.
"""
