"""HuMoR's model of how a body moves on: what the next state is, given this one (arXiv 2105.04668)."""
