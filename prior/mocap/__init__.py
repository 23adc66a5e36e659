"""Reads motion capture files as canonical joints, metres, z up: BVH with any rig, AMC, TRC, C3D, AMASS."""
