"""What is measured, against which peers, and the last results: ``python -m steadypose.benchmarks.NAME --help``."""
