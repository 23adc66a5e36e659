"""Cleaned motion as files that other programs read: BVH, GLB, CSV, TRC."""
