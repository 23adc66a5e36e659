"""What is known of human motion: skeletons, kinematics, the models and what is done with them."""
