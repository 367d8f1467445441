"""The tasks by name: each environment with its expert, its viewer and its configs; Gymnasium's as ours, and ours as Gymnasium's.

    registry           make, register, task: environments by name
    checking           check_environment: whether a task of your own is what training takes it for
    presets            preset: configs by name
    from_gymnasium     environments of Gymnasium, as tasks to learn; describing finds out what they are, success when they are solved, simulators
                       are many of them side by side, held_actions for several steps
    as_gymnasium       our environments as Gymnasium's
    ids                the entries in Gymnasium's registry, all that `import hindrl_jax` runs

A task of somebody else's joins them by `registry.register`.
"""
