"""Every figure in the docs comes from a script in this package; `python -m benchmarks` runs them."""
