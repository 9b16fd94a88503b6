"""Procedural motions of the synthetic data set: one function per action, which returns the body's curves."""
