"""Procedural motions of the synthetic data set. Each action is a function that moves the body."""
