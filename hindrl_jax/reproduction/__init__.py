"""Experiments that stand in tables: many runs, each a cell of a table, trained where they are not finished yet, and what became of them.

`cells` are the runs, `outcomes` their statistics beside a baseline, `tables` and `picture` show these; the four know no experiment by name.
`ablation` is the recipe with one change at a time, and `options` are the changes.
"""
