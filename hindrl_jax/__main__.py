"""`python -m hindrl_jax` is the `hindrl` command."""

from hindrl_jax.cli import main

if __name__ == "__main__":
    main()
