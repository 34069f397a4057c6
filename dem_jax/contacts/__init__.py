"""Contact pipeline: geometry, materials and contact law of each contact, sums over contacts, and
wall statistics.
"""
