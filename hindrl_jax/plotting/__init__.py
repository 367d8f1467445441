"""Pictures, films and the statistics that they show.

Public are `curves` (Matplotlib), `films` (GIF, MP4 and PNG) and `statistics` (estimates over seeds with bootstrap intervals).
"""
