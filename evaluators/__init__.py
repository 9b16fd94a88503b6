"""Evaluation: protocols, the evaluator, metrics, and the feature extractors that they read."""
