"""Test-time optimisation of whole recordings (HuMoR, section 4), which needs torch."""
