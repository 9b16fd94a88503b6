# pyright: standard
"""Sampling: requests, generation, editing, sequences of texts, and world-space targets."""
