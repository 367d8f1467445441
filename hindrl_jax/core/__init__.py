"""The algorithm, as pure functions over documented pytrees: no disk, no printing, no environment by name.

Public are, from the ground up, `goals`, `hindsight`, `priorities`, `replay`, `networks`, `losses`, `agent`, `rollout` and `train`; the last one's
`guidance`, `init`, `collect`, `learn` and `evaluate` are what the room `training` compiles.
"""
