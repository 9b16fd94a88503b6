# pyright: standard
"""Sampling: requests, generation, editing, sequences of texts, and targets in the world."""
