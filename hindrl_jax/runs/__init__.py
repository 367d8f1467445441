"""A run's directory: what it was asked to do, written as the training goes, gone on with after a stop, and read back.

`spec` is what a run was asked to do and the names of its files, `writer` and `sweep` write directories, `reporter` says whom else they tell,
`checkpoints` is what a run goes on from, `reader` reads its policies back and `recorded` how it went.
"""
