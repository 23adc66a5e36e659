"""What takes a whole recording at once: test-time optimisation (HuMoR, section 4). It needs torch."""
