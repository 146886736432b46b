"""Time to fit the same arrays with other people's solvers: ``python -m benchmarks.peers``."""
