"""The lowest layer: what every other package may use. It uses no other package of this project.

Public are `types` (the pytrees that packages hand each other), `environments` and `steppers` (what an environment can do, in JAX and outside it),
`errors` (`UserError`), `checks` of the fields of dataclasses, `files` that are written whole or not at all, and `extras`, which imports optional
packages.
"""
