"""The directory of a run or a sweep: what was asked for, how it went, and the policies that came of it.

Public are `spec` (`RunSpec`, what config.json says), `writer` (`save_run`), `reader` (`load_run`, `Run`), `sweep` and `checkpoints` (`Checkpoints`).
"""
