"""How trainings go and went, for a person: while one runs, and several side by side afterwards.

Public are `progress` (`ProgressBar`), `reporters` (`TensorBoardReporter`, `WandbReporter`) and `compare`, which reads runs back and compares them.
"""
