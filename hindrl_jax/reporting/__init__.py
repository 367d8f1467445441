"""What is said of trainings to people: how one goes, in TensorBoard or W&B, and how several went, side by side.

`reporters` shows a training under way elsewhere than on the screen, `compare` sets recorded runs side by side, `picture` draws them.
"""
