"""How fast hindrl_jax is, beside what else there is; see README.md. Run with `make bench` or `python -m benchmarks.run`."""
