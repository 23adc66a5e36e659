"""HuMoR's experiments (arXiv 2105.04668, sections 5.3 to 5.5) on motion capture that is free for products."""
