"""Benchmarks: protocols, baselines, and the last results: ``python -m steadypose.benchmarks.NAME --help``."""
