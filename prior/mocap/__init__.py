"""Files of motion capture as canonical joints, metres, z up: BVH of any rig, AMC, TRC, C3D, AMASS."""
