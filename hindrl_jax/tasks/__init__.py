"""The tasks by name: each environment with its expert, its viewer and its configs, ours and Gymnasium's.

Public are `registry` (`make`, `register`, `task`), `presets` (`preset`), `from_gymnasium` (Gymnasium's environments as ours), `as_gymnasium` (ours as
Gymnasium's) and `ids` (the entries in Gymnasium's registry, all that `import hindrl_jax` runs).
"""
