"""The algorithm, as pure functions over documented pytrees: no disk, no printing, no environment by name.

All modules are public. Data: `goals`, `hindsight` (sources of goals), `replay`, `steps`, `relabel`, `batch`. Learning: `networks`, `inputs`, `losses`
over `kernels`, `comparison` (of actions), `agent`. Both together: `rollout`, `guidance` (what demonstrations give), `holding` (actions for several
steps), `schedules`, `randomness`, and `train`, whose functions the package `training` compiles.
"""
