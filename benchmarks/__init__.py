"""Benchmarks: protocols, peers, and the last results: ``python -m steadypose.benchmarks.NAME --help``."""
