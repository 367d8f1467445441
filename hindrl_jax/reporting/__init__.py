"""What is said of trainings to people: how one goes, on the screen, in TensorBoard or W&B, and how several went, side by side.

`progress` has the bar of a training under way, `reporters` what shows it elsewhere, `compare` sets recorded runs side by side, `picture` draws them.
"""
