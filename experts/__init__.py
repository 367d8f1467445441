"""Scripted experts that act from the state of an environment (thesis section 4.2)."""
