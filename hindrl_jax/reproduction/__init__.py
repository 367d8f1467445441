"""Experiments that stand in tables: many runs, each a cell of a table, trained where they are not finished yet, and what became of them.

`cells` are the runs; it knows no experiment by name. There are two:

- the ablation, a recipe with one change at a time: `ablation`, `options` are the changes, `outcomes` are statistics beside a baseline, `tables` and
  `picture` show them;
- the thesis: `thesis` are its tables and figures, `scales` how much of them is run, `measures` and `claims` what is made of the runs, `thesis_report`
  and `thesis_pictures` show it.
"""
