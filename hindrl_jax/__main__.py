"""`python -m hindrl_jax` is the `hindrl` command."""

from hindrl_jax.cli import main

main()
