"""What takes a whole recording at once: test-time optimisation (HuMoR, section 4), which needs torch; completion."""
