"""Benchmarks: studies, baselines and the latest results. Run ``steadypose evaluate STUDY``."""
