"""Pictures, films and statistics of trainings: what is drawn of a result and of a task, and what every other picture of the project is made with.

`figures` has the helpers that pictures share, `statistics` the estimates with their bootstrap intervals, `curves` success over training and the
epsilon filter, `films` episodes.
"""
