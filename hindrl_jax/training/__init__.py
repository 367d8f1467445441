"""Training, recording and playing in memory: many seeds in one program, spread over devices; no disk and no printing.

Public are `experiment` (`fit`, `Result`, `record_demonstrations`), `recording`, `host` (environments that are stepped outside JAX) and `devices`.
"""
