# pyright: standard
"""Sampling: requests, generation, editing, sequences of actions, and world-space targets."""
