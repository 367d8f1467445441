"""Experiments that are lists of settings over run directories, each trained unless its run is there already, and their tables.

Public is `ablation`: the recipe with one change at a time.
"""
