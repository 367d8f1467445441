"""The ground floor: what every other room may use, and nothing of this project below it.

Public are `types` (the pytrees that rooms hand each other), `environments` and `steppers` (what an environment can do, in JAX and outside it),
`errors` (`UserError`), `checks` of the fields of dataclasses, `files` that are written whole or not at all, and `extras`, which imports optional
packages.
"""
