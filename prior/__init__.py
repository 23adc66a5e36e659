"""The prior of human motion: skeletons, kinematics, models, and the pipelines that use them. No sockets, no clocks."""
