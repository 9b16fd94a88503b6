# pyright: standard
"""Evaluation: protocols, the evaluator, metrics and feature extractors."""
