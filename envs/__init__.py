"""Environments: one file or folder each, with state, dynamics and observation; drawing lives in a viewer that the dynamics never import."""
